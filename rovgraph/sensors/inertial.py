"""The inertial unit, which carries the estimate from one measurement to the next."""

from rovgraph.sensors.sensor import Column, Sensor

IMU = Sensor(
    "imu",
    (
        *(Column(name, "acceleration", group="acc") for name in ("acc_x", "acc_y", "acc_z")),
        *(Column(name, "rate", group="gyr") for name in ("gyr_x", "gyr_y", "gyr_z")),
    ),
    usual_rates=(5.0, 4000.0),
    if_missing=(
        "error",
        "no IMU: the attitude between measurements is unknown; give acc_x, acc_y, acc_z, gyr_x, gyr_y, gyr_z, "
        "or roll and pitch instead",
    ),
)
