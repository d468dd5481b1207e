"""rovgraph: where a small underwater vehicle was, and where it is.

This docstring is the contract for frames, units and names in the whole package.

Frames
------
n : navigation frame, north-east-down (NED), flat, local origin, taken as inertial
    unless ``environment.earth_rotation`` is set.
b : body frame, forward-right-down (FRD): x forward, y starboard, z down.
s : sensor frame. A sensor's mounting is ``R_bs`` (sensor to body, written
    ``mount_rpy_deg`` in a configuration) and ``lever_arm_b`` (metres, body axes).
    An instrument whose z axis points up is a mounting of 180 degrees about x, never
    a sign flipped in code.

Notation
--------
``R_nb`` takes vectors from b to n: ``v_n = R_nb @ v_b``. ``p_n`` is position,
``v_n`` velocity over ground, both in n. Angles are radians, everything else SI.
Degrees occur only in configuration keys that end in ``_deg`` and in what a person reads.
Roll, pitch, yaw are the ZYX convention, ``R_nb = Rz(yaw) Ry(pitch) Rx(roll)``.
Heading is clockwise from north; depth is positive down.
``*_sd`` is one standard deviation.

Tangent space
-------------
As in GTSAM: a pose is perturbed on the right, rotation first,
``R_nb <- R_nb Exp(dtheta)``, ``p_n <- p_n + R_nb dp``; velocity is perturbed in n;
a bias is accelerometer first, gyro second, in body axes.

Arrays
------
Quantities of many epochs carry the epochs on the leading axis: positions are
``(n, 3)``, rotations ``(n, 3, 3)``, Jacobians ``(n, dim of measurement, dim of variable)``.

Layers (imports go downwards only)
----------------------------------
cli / report / studies, live / estimators, simulate, evaluate, check, calibrate / graph / engine /
instruments / log / sensors / config, trajectory / vehicle /
state, calibration, thesis / kernels / geometry, workers, fast_csv / errors, process.
"""

__version__ = "0.1.0"
