"""Judges rovers: pays only if each drive ended within half a metre of where it should."""

from collections.abc import Iterator

from mesh import Evidence, Validator

validator = Validator(policies=["acknowledged:command=/drive:answer=/driven:within=2m", "schema"], title="Rovers")


@validator.check("distance", description="Each drive is as long as it was commanded, to within 0.5 m.")
def distance(evidence: Evidence) -> Iterator[str]:
    due = [move.value["speed"] * move.value.get("seconds", 1.0) for move in evidence.played.on("/drive")]
    driven = [message.value for message in evidence.device.on("/driven")]
    for number, (expected, found) in enumerate(zip(due, driven, strict=False)):
        if abs(expected - found) > 0.5:
            yield f"drive {number} was {found:.1f} m long, not {expected:.1f} m"


if __name__ == "__main__":
    validator.run()
