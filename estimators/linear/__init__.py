"""Linear estimators on squared ranges: the Kalman filters of the tracking paper, least squares."""
