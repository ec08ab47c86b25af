"""Nodes of rospy, as users write them; Debian's Python runs this file: `python3 nodes.py FUNCTION ARGUMENTS`.

What they hear and do they print, a JSON line each.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile

import rospy
from std_msgs.msg import Empty, String


def say(value: object) -> None:
    """Print a line of JSON."""
    print(json.dumps(value), flush=True)


def heard() -> object:
    """The next line that the test sends; the node ends with the test."""
    line = sys.stdin.readline()
    if not line:
        sys.exit()
    return json.loads(line)


def talker(topic: str) -> None:
    """Publish the texts that the test sends, once somebody subscribes."""
    publisher = rospy.Publisher(topic, String, queue_size=1000)
    say("ready")
    while True:
        text = heard()
        while not publisher.get_num_connections():
            rospy.sleep(0.01)
        publisher.publish(String(text))


def listener(topic: str) -> None:
    """Print the texts on a topic."""
    rospy.Subscriber(topic, String, lambda message: say(message.data))
    say("ready")
    rospy.spin()


def echo(heard_on: str, said_on: str) -> None:
    """Publish what is heard."""
    publisher = rospy.Publisher(said_on, String, queue_size=1000, tcp_nodelay=True)
    rospy.Subscriber(heard_on, String, publisher.publish, tcp_nodelay=True)
    say("ready")
    rospy.spin()


def demands(topic: str) -> None:
    """Print the demands on a topic, in the version of the packages that are installed."""
    from robonomics_msgs.msg import Demand

    def on_demand(demand: Demand) -> None:
        model = demand.model if isinstance(demand.model, str) else demand.model.multihash
        cost = demand.cost if isinstance(demand.cost, int) else demand.cost.uint256
        say({"sum": Demand._md5sum, "model": model, "cost": cost})

    rospy.Subscriber(topic, Demand, on_demand)
    say("ready")
    rospy.spin()


def text(value: object) -> str:
    """The text of an address or hash: in later generations it is a message of one field."""
    return value if isinstance(value, str) else getattr(value, value.__slots__[0])  # type: ignore[attr-defined]


def offer_for_demands() -> None:
    """Offer whatever is demanded, as the robots of the tutorials do."""
    from robonomics_msgs.msg import Demand, Offer

    offers = rospy.Publisher("/liability/infochan/eth/signing/offer", Offer, queue_size=10)

    def on_demand(demand: Demand) -> None:
        offer = Offer()
        for field in ("model", "objective", "token", "cost", "lighthouse", "validator", "deadline"):
            setattr(offer, field, getattr(demand, field))
        offers.publish(offer)

    while not offers.get_num_connections():  # what is published before is lost, as always in ROS 1
        rospy.sleep(0.01)
    rospy.Subscriber("/liability/infochan/incoming/demand", Demand, on_demand)


def blink(argument: str = "Empty", fate: str = "finish") -> None:
    """A robot that blinks as its objective says, says so, and ends the job.

    With `board` a board blinks, with `told` it waits for a line before it ends the job, with `die` it dies instead.
    """
    import std_msgs.msg
    from robonomics_liability.msg import Liability
    from robonomics_liability.srv import FinishLiability, StartLiability

    offer_for_demands()
    blink_led = rospy.Publisher("/blink_led", Empty, queue_size=10)
    start = rospy.ServiceProxy("/liability/start", StartLiability)
    finish = rospy.ServiceProxy("/liability/finish", FinishLiability)

    def on_ready(liability: Liability) -> None:
        below = "/liability/eth_" + text(liability.address)
        # Generation 4 has a message of one field in Liability, and a text in the services.
        address = text(liability.address) if start.request_class._slot_types == ["string"] else liability.address
        led = rospy.Publisher(below + "/led", String, queue_size=10)

        def on_blink(message: object) -> None:
            word = getattr(message, "data", "on")
            say({"blink": word})
            if fate == "die":
                os._exit(1)
            led.publish(String(word))
            if fate == "board":
                blink_led.publish(Empty())
                rospy.sleep(4)  # the board blinks three times
            if fate == "told":
                heard()
            if fate in ("finish", "told", "board"):
                finish(address=address, success=word in ("on", "red", "blue"))
                say("finished")

        rospy.Subscriber(below + "/blink", getattr(std_msgs.msg, argument), on_blink)
        say({"started": start(address=address).success})

    rospy.Subscriber("/liability/ready", Liability, on_ready)
    rospy.wait_for_service("/liability/start")
    say("ready")
    rospy.spin()


def hello(model: str) -> None:
    """The robot of the first tutorial: it greets whoever demands its model, and does a job of that model for money."""
    from robonomics_liability.msg import Liability
    from robonomics_liability.srv import FinishLiability, StartLiability
    from robonomics_msgs.msg import Demand

    offer_for_demands()
    start = rospy.ServiceProxy("/liability/start", StartLiability)
    finish = rospy.ServiceProxy("/liability/finish", FinishLiability)

    def on_demand(demand: Demand) -> None:
        if text(demand.model) == model:
            say("Hello AIRA")

    def on_ready(liability: Liability) -> None:
        below = "/liability/eth_" + text(liability.address)
        data = rospy.Publisher(below + "/data", String, queue_size=10)

        def on_task(task: String) -> None:
            data.publish(String("Hello " + task.data))
            finish(address=liability.address, success=True)

        rospy.Subscriber(below + "/task", String, on_task)
        start(address=liability.address)

    rospy.Subscriber("/liability/infochan/incoming/demand", Demand, on_demand)
    rospy.Subscriber("/liability/ready", Liability, on_ready)
    say("ready")
    rospy.spin()


def sensor() -> None:
    """A sensor that answers free demands with a bag of what its board has measured."""
    import rosbag
    from ipfs_common.msg import Filepath
    from ipfs_common.srv import IpfsUploadFile
    from robonomics_msgs.msg import Demand, Result

    results = rospy.Publisher("/liability/infochan/eth/signing/result", Result, queue_size=10)
    upload = rospy.ServiceProxy("/ipfs/add_file", IpfsUploadFile)

    def on_demand(demand: Demand) -> None:
        path = tempfile.mktemp(".bag")
        with rosbag.Bag(path, "w") as bag:
            bag.write("/measurements", rospy.wait_for_message("/measurements", String))
        answer = upload(Filepath(path))
        result = Result(success=True, result=answer.ipfs_address)
        result.liability.address = text(demand.lighthouse)
        results.publish(result)
        say({"added": answer.success, "why": answer.error_msg, "cid": text(answer.ipfs_address)})

    rospy.Subscriber("/liability/infochan/incoming/demand", Demand, on_demand)
    rospy.wait_for_service("/ipfs/add_file")
    while not results.get_num_connections():  # what is published before is lost
        rospy.sleep(0.01)
    say("ready")
    rospy.spin()


def light() -> None:
    """A robot with a light that can be turned on, and not off."""
    from std_srvs.srv import SetBool, SetBoolResponse

    def switch(request: SetBool) -> SetBoolResponse:
        say({"light": request.data})
        return SetBoolResponse(request.data, "" if request.data else "the switch is stuck")

    rospy.Service("/light", SetBool, switch)
    say("ready")
    rospy.spin()


if __name__ == "__main__":
    rospy.init_node(f"test_{sys.argv[1]}", anonymous=True)
    globals()[sys.argv[1]](*sys.argv[2:])
