from bridges.ros1._wire import Ros1Error as Ros1Error
from bridges.ros1.master import RosMaster as RosMaster
from bridges.ros1.messages import Ros1ServiceType as Ros1ServiceType, Ros1Type as Ros1Type
from bridges.ros1.node import (
    Ros1Graph as Ros1Graph,
    Ros1Node as Ros1Node,
    Ros1Publisher as Ros1Publisher,
    Ros1Subscription as Ros1Subscription,
)
