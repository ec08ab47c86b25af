"""An agent's own model: its description, derived from the handlers or read from a file, and whether both agree."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from mesh.errors import ChainError, ConfigurationError
from mesh.work.models import description_in
from mesh.work.topic_handlers import ANY_TOPIC
from schemas import cid_of_file
from schemas.model import ModelDescription
from schemas.value_types import topic_gap, topic_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from mesh.agent.components import AgentComponents
    from mesh.work.models import Models
    from mesh.work.topic_handlers import TopicHandlers

PIN: Final = "model"
"""The pin of the file of an agent's model in its store: others fetch it from there."""


class ModelUnfit(ConfigurationError, code="model-unfit"):
    """The handlers of an agent don't fit the description of its model: it would take orders that it can't do."""

    def __init__(self, model: str, why: str) -> None:
        hint = "change the handlers or the description; `aira model new PROGRAM.py` writes one from the handlers"
        super().__init__(f"the handlers don't fit the model {model}: {why}", hint=hint)
        self.model = model
        self.why = why


class ModelUnreadable(ConfigurationError, code="model-unreadable"):
    """The file that is an agent's model can't be read."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"can't read the model {path}: {why}", hint="`aira model new PROGRAM.py` writes one")
        self.path = path


def model_of(model: str | Path, *, missing: str | None = None) -> str:
    """The model that an agent is given: its name, or the CID of its file. Raises `ModelUnreadable`.

    If `missing` is given, it is returned for a file that can't be read.
    """
    if isinstance(model, str):
        return model
    try:
        return cid_of_file(model)
    except OSError as error:
        if missing is None:
            raise ModelUnreadable(model, error.strerror or str(error)) from None
        return missing


def derived(topics: TopicHandlers, result: Mapping[str, Any], fields: dict[str, Any]) -> ModelDescription:
    """The description of what these handlers take; `result` has the Python type of each topic that they publish.

    `fields` are others of `ModelDescription`. Raises `InvalidDescription`.
    """
    taken = topics.declared
    description = ModelDescription(
        objective=tuple(topic_of(topic, kind) for topic, kind in taken.items() if topic != ANY_TOPIC),
        other_topics=ANY_TOPIC in taken,
        result=tuple(topic_of(topic, kind) for topic, kind in result.items()),
        **fields,
    )
    description.encode()  # a constructor does not check lengths and ranges
    return description


def require_fit(description: ModelDescription, topics: TopicHandlers) -> None:
    """Raise `ModelUnfit` unless the handlers take every message that the description allows, and no other topics.

    An agent without handlers leaves the work to devices, of which nothing is known here.
    """
    taken = topics.declared
    if not taken:
        return
    for topic in description.objective:
        kind = taken.get(topic.topic, taken.get(ANY_TOPIC))
        if kind is None:
            raise ModelUnfit(description.cid, f"no handler takes {topic.topic}")
        if why := topic_gap(topic, topic_of(topic.topic, kind)):
            raise ModelUnfit(description.cid, why)
    if description.other_topics and ANY_TOPIC not in taken:
        raise ModelUnfit(description.cid, "no handler takes other topics")
    if not description.other_topics:
        unknown = sorted(topic for topic in taken if topic != ANY_TOPIC and description.topic(topic) is None)
        if unknown:
            raise ModelUnfit(description.cid, f"the model has no topic {unknown[0]}, which a handler takes")


async def own_description(
    parts: AgentComponents, models: Models, model: str | Path, topics: TopicHandlers
) -> ModelDescription | None:
    """The description of an agent's own model, which its handlers fit; None if it has none, or nobody serves it now.

    A file is put into the store, from which others fetch it. Raises `InvalidDescription`, `ModelUnfit`,
    `ModelUnreadable`.
    """
    if isinstance(model, str):
        description = None
        with suppress(ChainError):  # a name that can't be resolved now
            cid = await parts.chain.names.model(model) if model else ""
            description = await models.find(cid) if cid else None
    else:
        try:
            description = await asyncio.to_thread(description_in, model)
            await asyncio.to_thread(parts.store.put_file, model, pin=PIN)
        except OSError as error:
            raise ModelUnreadable(model, error.strerror or str(error)) from None
    if description is not None:
        require_fit(description, topics)
    return description
