"""Judges rovers: pays only if each drive ended within half a metre of where it should."""

from collections.abc import Iterator

from mesh import Evidence, Validator

validator = Validator(policies=["acknowledged:command=/drive:answer=/driven:within=2m", "schema"], title="Rovers")


@validator.check("distance", description="Each drive is as long as it was commanded, to within 0.5 m.")
def distance(evidence: Evidence) -> Iterator[str]:
    driven = [message.value for message in evidence.device.on("/driven")]
    left = iter(driven)  # after a crash, a drive may be there twice
    for number, move in enumerate(evidence.objective.on("/drive")):
        due = move.value["speed"] * move.value.get("seconds", 1.0)
        if not any(abs(due - metres) <= 0.5 for metres in left):
            yield f"drive {number} was not {due:.1f} m long: the rover drove {driven} m"


if __name__ == "__main__":
    validator.run()
