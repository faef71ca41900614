"""Defaults and limits of a query's options. The contract and the core read them here, so a client needs no core."""

#: Default and upper limit of the option ``neighbours``.
NEIGHBOURS, MOST_NEIGHBOURS = 5, 50
#: Default share of the out-of-map queries in calibration that may be accepted. All kinds have equal weight (decisions 0039, 0149).
FALSE_ACCEPT_RATE = 0.01
#: Least confidence of a LOCALIZED answer at the default rate, and at lower ones. A higher rate accepts more answers.
SAFE_CONFIDENCE = 0.9
#: Least confidence of a LOCALIZED answer at any rate: a pose that is more likely wrong than right is no answer.
LEAST_CONFIDENCE = 0.5
#: Lower limit of the option ``false_accept_rate``. No calibration could measure a lower rate.
LEAST_FALSE_ACCEPT_RATE = 1e-6
#: Shortest side of an image, pixels, and largest ratio of its sides. The longer side determines the memory of an answer.
LEAST_SIDE, MOST_ASPECT = 2, 16
#: Limits of a camera's height above the ground, metres.
LEAST_HEIGHT_M, MOST_HEIGHT_M = 0.05, 30.0
#: Limits of the standard deviation of a given height, and its default, metres.
LEAST_HEIGHT_STD_M, MOST_HEIGHT_STD_M, HEIGHT_STD_M = 0.005, 2.0, 0.05
#: Limits of the baseline of a stereo rig, metres.
LEAST_BASELINE_M, MOST_BASELINE_M = 1e-3, 100
#: Standard deviation of a height that follows from the camera's pose on the vehicle, metres: tyres, suspension and load.
VEHICLE_HEIGHT_STD_M = 0.1
#: Limits of the standard deviations of odometry: per axis, metres and degrees.
LEAST_ODOMETRY_STD_M, MOST_ODOMETRY_STD_M = 1e-4, 100.0
LEAST_ODOMETRY_STD_DEG, MOST_ODOMETRY_STD_DEG = 1e-3, 180.0
