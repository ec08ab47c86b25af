"""What pamoja-ros2 says: `python pamoja_answers.py` reads lines of JSON, each a function and its arguments.

Run by the Python that has it. Bytes travel as hexadecimal text.
"""

from __future__ import annotations

import json
import sys

from pamoja import ros2


def main() -> None:
    """Answer each line with one."""
    for line in sys.stdin:
        function, *arguments = json.loads(line)
        taken = [tuple(one) if isinstance(one, list) else one for one in arguments]
        answer = getattr(ros2, function)(*taken)
        print(json.dumps(answer.hex() if isinstance(answer, bytes) else answer), flush=True)


if __name__ == "__main__":
    main()
