"""A validator with a policy of its own: the lamp answered each command within a second."""

from collections.abc import Iterator

from mesh import Evidence, Validator

SECONDS = 1.0

validator = Validator(policies=["complete", "schema"], title="Lamp judge")


@validator.check("lamp-answers", description="The lamp is on within a second of each command.")
def lamp_answers(evidence: Evidence) -> Iterator[str]:
    lit = [message.time for message in evidence.device.on("/led") if message.value == "on"]
    for command in evidence.played:
        if not any(0 <= time - command.time <= SECONDS for time in lit):
            yield f"the lamp was not on within {SECONDS:g} s of the command at {command.time:.2f} s"


if __name__ == "__main__":
    validator.run()
