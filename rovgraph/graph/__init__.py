"""The factor graph: the only place that touches GTSAM graphs, factors and solvers.

assembly        measurements in order of time -> keyframes and what lies between them
preintegration  IMU samples between two keyframes -> one preintegrated motion
measurements    measurements of one sensor, linearised all at once or one by one
factors         the lists of factors: priors, and each interval's
batch           Gauss-Newton with step control over the whole dive
incremental     iSAM2
"""
