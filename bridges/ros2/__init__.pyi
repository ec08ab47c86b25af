from bridges.ros2._services import RosActionServer as RosActionServer, RosGoal as RosGoal
from bridges.ros2._node import RosGraph as RosGraph
from bridges.ros2._robot import Robot as Robot, RosAllowed as RosAllowed
from bridges.ros2._services import RosParameters as RosParameters, RosServer as RosServer
from bridges.ros2._node import (
    RosMessage as RosMessage,
    RosPublisher as RosPublisher,
    RosSubscription as RosSubscription,
)
from bridges.ros2._wire import (
    LATCHED as LATCHED,
    SENSOR_DATA as SENSOR_DATA,
    RosEntity as RosEntity,
    RosError as RosError,
    RosGoalFailed as RosGoalFailed,
    RosQos as RosQos,
)
