"""Two jaws on a robot's wrist: `ros2 launch finforce robot.launch.py object_mesh:=FILE arm:=true robot_ip:=ADDRESS`.

`sim:=true` needs no hardware: `ros2 launch finforce robot.launch.py sim:=true`.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction

from finforce.systems.launch import SWITCH, gripper_arguments, launch_action, options_from_texts, solver_arguments
from finforce.systems.live import robot_processes
from finforce.systems.processes import RobotOptions

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return camera, detector, contacts, solvers, gripper, arm; with `config/robot.yaml` or `robot_sim.yaml`."""
    return LaunchDescription(
        [
            *solver_arguments(images="true"),
            *gripper_arguments(),
            DeclareLaunchArgument("gripper", default_value="true", choices=SWITCH, description="drive the gripper"),
            DeclareLaunchArgument(
                "camera",
                default_value="true",
                choices=SWITCH,
                description="start the wrist camera, a RealSense D405, by realsense2_camera; not with sim",
            ),
            DeclareLaunchArgument(
                "camera_name",
                default_value="wrist_camera",
                description="topics /camera/NAME/..., frames NAME_...; none: topics and frame of the parameter file",
            ),
            DeclareLaunchArgument(
                "camera_config",
                default_value="none",
                description="YAML file with parameters of realsense2_camera; none: the shipped d405.yaml",
            ),
            DeclareLaunchArgument(
                "camera_serial", default_value="none", description="serial number of the camera; none: the only one"
            ),
            DeclareLaunchArgument(
                "arm",
                default_value="false",
                choices=SWITCH,
                description="start the arm, a Kinova Gen3, by kortex_bringup; with sim one that is not there",
            ),
            DeclareLaunchArgument(
                "arm_description",
                default_value="none",
                description="xacro file of arm and gripper; none: the shipped one, the gripper on the flange of a Gen3",
            ),
            DeclareLaunchArgument("robot_ip", default_value="192.168.1.10", description="address of the arm"),
            DeclareLaunchArgument("dof", default_value="7", choices=["6", "7"], description="joints of the arm"),
            DeclareLaunchArgument(
                "use_fake_hardware",
                default_value="false",
                choices=SWITCH,
                description="an arm that is not there: it mirrors its commands",
            ),
            OpaqueFunction(function=start),
        ]
    )


def start(context):
    """Return an action for every process that the arguments ask for."""
    options = options_from_texts(RobotOptions, context.launch_configurations)
    return [launch_action(part) for part in robot_processes(options, SHARE)]
