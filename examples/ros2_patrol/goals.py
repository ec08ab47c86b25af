"""Writes the objective: `python goals.py patrol.mcap 1,0 1,1 0,0` has the rover drive to these places (metres)."""

import sys
from pathlib import Path

from mesh import pack_values
from patrol import GOAL, ros


def goal(place: str) -> object:
    x, y = map(float, place.split(","))
    pose = {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}
    return ros.message("geometry_msgs/PoseStamped", header={"frame_id": "map"}, pose=pose)


if __name__ == "__main__":
    pack_values([(GOAL, goal(place)) for place in sys.argv[2:]], Path(sys.argv[1]))
