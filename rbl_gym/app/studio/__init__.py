"""A page in the browser on which anchors are placed by hand; extra ``studio``."""

from rbl_gym.app.studio.opening import Options, Studio, show

__all__ = ["Options", "Studio", "show"]
