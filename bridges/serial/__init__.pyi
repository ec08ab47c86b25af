from bridges.serial._device import CallReply as CallReply, Device as Device
from bridges.serial.boards import simulated_board as simulated_board
from bridges.serial.dialect import CallFailed as CallFailed, CallStatus as CallStatus
