"""A ROS 2 node that publishes what ``rovgraph online`` computes, as nav_msgs/Odometry, NavSatFix and tf.

    rovgraph online SOURCE... --output tcp://:5600
    python rovgraph_bridge.py --ros-args -p port:=5600

It runs wherever ROS 2 is sourced (rclpy, nav_msgs, sensor_msgs, tf2_ros); rovgraph itself need not be installed there.
Frames are those of REP 103 and REP 105: ``odom`` has x east, y north, z up; ``base_link`` x forward, y left, z up.
"""

import json
import math
import socket
import threading

PORT = 5600
RETRY_S = 2.0  # between attempts to reach rovgraph


def quaternion_of(roll, pitch, yaw):
    """Of base_link in odom, (x, y, z, w), from the vehicle's attitude to north, east and down [rad]."""
    roll, pitch, yaw = roll, -pitch, math.pi / 2.0 - yaw
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def in_body(vector, quaternion):
    """A vector of odom in base_link's axes."""
    x, y, z, w = quaternion
    a, b, c = vector
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + z * w) * b + 2 * (x * z - y * w) * c,
        2 * (x * y - z * w) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + x * w) * c,
        2 * (x * z + y * w) * a + 2 * (y * z - x * w) * b + (1 - 2 * (x * x + y * y)) * c,
    )


def odometry_of(solution):
    """What nav_msgs/Odometry says of a solution: position, orientation, velocity, and both covariances.

    Of velocity, rovgraph states the sd along north, east and down: the largest stands for all axes of the body. It
    states no rate, which is marked as unknown (-1).
    """
    s = solution
    quaternion = quaternion_of(s["roll"], s["pitch"], s["yaw"])
    velocity = in_body((s["v_east"], s["v_north"], -s["v_down"]), quaternion)
    pose = [0.0] * 36
    for k, name in enumerate(("east", "north", "down", "roll", "pitch", "yaw")):
        pose[7 * k] = s[f"{name}_sd"] ** 2
    pose[1] = pose[6] = s["cov_north_east"]
    twist = [0.0] * 36
    for k in range(3):
        twist[7 * k] = max(s["v_north_sd"], s["v_east_sd"], s["v_down_sd"]) ** 2
        twist[7 * (k + 3)] = -1.0
    return (s["east"], s["north"], -s["down"]), quaternion, velocity, pose, twist


def solutions(host, port, stop):
    """Solutions of a running ``rovgraph online``, of one that is started again, too."""
    while not stop.is_set():
        try:
            with socket.create_connection((host, port), timeout=5.0) as connection:
                connection.settimeout(None)
                for line in connection.makefile(encoding="ascii"):
                    yield json.loads(line)
        except OSError:
            pass
        stop.wait(RETRY_S)


def main():
    """Publish until ROS shuts down."""
    import rclpy
    from geometry_msgs.msg import TransformStamped
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from sensor_msgs.msg import NavSatFix
    from tf2_ros import TransformBroadcaster

    rclpy.init()
    node = Node("rovgraph_bridge")
    host = node.declare_parameter("host", "127.0.0.1").value
    port = node.declare_parameter("port", PORT).value
    frame = node.declare_parameter("frame", "odom").value
    body = node.declare_parameter("body", "base_link").value
    odometry = node.create_publisher(Odometry, "rovgraph/odometry", 10)
    places = node.create_publisher(NavSatFix, "rovgraph/fix", 10)
    transforms, stop = TransformBroadcaster(node), threading.Event()

    def publish(solution):
        (x, y, z), (qx, qy, qz, qw), (vx, vy, vz), pose, twist = odometry_of(solution)
        message, transform = Odometry(), TransformStamped()
        message.header.stamp = node.get_clock().now().to_msg()  # rovgraph's clock may be the autopilot's
        message.header.frame_id, message.child_frame_id = frame, body
        at, turned, along = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
        at.x, at.y, at.z = x, y, z
        turned.x, turned.y, turned.z, turned.w = qx, qy, qz, qw
        along.x, along.y, along.z = vx, vy, vz
        message.pose.covariance, message.twist.covariance = pose, twist
        odometry.publish(message)
        transform.header, transform.child_frame_id = message.header, body
        moved = transform.transform.translation
        moved.x, moved.y, moved.z = x, y, z
        transform.transform.rotation = turned
        transforms.sendTransform(transform)
        if solution["latitude"] is not None:
            fix = NavSatFix()
            fix.header = message.header
            fix.latitude, fix.longitude, fix.altitude = solution["latitude"], solution["longitude"], z
            fix.position_covariance = [pose[0], pose[1], 0.0, pose[6], pose[7], 0.0, 0.0, 0.0, pose[14]]
            fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
            places.publish(fix)

    def follow():
        for solution in solutions(host, port, stop):
            publish(solution)

    threading.Thread(target=follow, daemon=True).start()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        stop.set()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
