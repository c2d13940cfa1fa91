"""The web page on which a user places anchors by hand; extra ``studio``."""

from rbl_gym.app.studio.opening import Options, Studio, show

__all__ = ["Options", "Studio", "show"]
