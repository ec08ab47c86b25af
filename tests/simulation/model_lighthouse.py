# ruff: noqa: N802 - functions have the names of those in contracts/src, where they are described
"""A model of lighthouses: providers, stakes and turns (`Turns.sol`, `Lighthouse.sol`)."""

from __future__ import annotations

from typing import NamedTuple

from tests.simulation.model_abi import ModelRevert, checked, encode, functions, refused
from tests.simulation.model_contracts import NOBODY, ModelContract, ModelToken

MOST_QUOTA = 2**32 - 1
FINALIZE = next(selector for selector, one in functions("Liability").items() if one.name == "finalize")
FINALIZE_LIABILITY = next(
    selector for selector, one in functions("Lighthouse").items() if one.name == "finalizeLiability"
)


class ModelTurn(NamedTuple):
    """Whose turn it is, the block from which silence counts, and how many transactions are left."""

    provider: bytes = NOBODY
    keep_alive: int = 0
    quota: int = 0


class ModelPlace(NamedTuple):
    """A provider's neighbours in the ring, and its place in the list, counted from 1."""

    next: bytes = NOBODY
    number: int = 0
    previous: bytes = NOBODY


class ModelTurns(ModelContract):
    """Providers and their turns."""

    NAME = "Lighthouse"

    def minimalStake(self) -> int:
        return int(self.get("minimal stake"))

    def timeoutInBlocks(self) -> int:
        return int(self.get("timeout"))

    def _turn(self) -> ModelTurn:
        turn: ModelTurn = self.get("turn", default=ModelTurn())
        return turn

    def _place(self, provider: bytes) -> ModelPlace:
        place: ModelPlace = self.get("place", provider, default=ModelPlace())
        return place

    def _list(self) -> tuple[bytes, ...]:
        listed: tuple[bytes, ...] = self.get("providers", default=())
        return listed

    def stakes(self, provider: bytes) -> int:
        return int(self.get("stake", provider))

    def isTurnOf(self, provider: bytes) -> bool:
        return self.indexOf(provider) != 0 and self._may_take(self._turn(), provider)

    def current(self) -> bytes:
        return self._turn().provider

    def marker(self) -> int:
        return self.indexOf(self._turn().provider)

    def quota(self) -> int:
        return self._turn().quota

    def keepAliveBlock(self) -> int:
        return self._turn().keep_alive

    def quotaOf(self, provider: bytes) -> int:
        return min(self.stakes(provider) // self.minimalStake(), MOST_QUOTA)

    def providers(self, index: int) -> bytes:
        if index >= len(self._list()):
            raise refused("NoSuchProvider", index)
        return self._list()[index]

    def providersLength(self) -> int:
        return len(self._list())

    def indexOf(self, provider: bytes) -> int:
        return self._place(provider).number

    def queue(self, first: bytes, limit: int) -> tuple[list[bytes], list[int], bytes]:
        head = self._turn().provider
        if first == NOBODY:
            first = head
        following = first if self.indexOf(first) else NOBODY
        accounts: list[bytes] = []
        while len(accounts) < min(limit, len(self._list())) and following != NOBODY:
            accounts.append(following)
            following = self._place(following).next
            if following == head:
                following = NOBODY
        return accounts, [self.stakes(account) for account in accounts], following

    def _use_turn(self) -> None:
        turn = self._turn()
        if turn.provider != self.sender:
            turn = self._take(turn)
        if turn.quota > 1:
            turn = turn._replace(quota=turn.quota - 1)
        else:
            turn = self._begin(turn, self._place(turn.provider).next)
        self.set("turn", turn._replace(keep_alive=self.run.block))

    def _set_stake(self, provider: bytes, stake: int) -> None:
        if stake < self.minimalStake():
            raise refused("StakeTooSmall", stake, self.minimalStake())
        self.set("stake", provider, stake)
        if not self.indexOf(provider):
            self._enter(provider)
        turn = self._turn()
        if turn.provider == provider and turn.quota > self.quotaOf(provider):
            self.set("turn", turn._replace(quota=self.quotaOf(provider)))

    def _leave(self, provider: bytes) -> None:
        turn, place = self._turn(), self._place(provider)
        self._unlist(place.number)
        self._unlink(provider)
        self.set("place", provider, ModelPlace())
        self.set("stake", provider, 0)
        self.log("Offline", provider)
        if not self._list():
            self.set("turn", ModelTurn())
            return
        if turn.provider == provider:
            turn = self._begin(turn, place.next)
        elif turn.provider != place.previous:
            return
        self.set("turn", self._shorten_silence(turn))

    def _enter(self, provider: bytes) -> None:
        turn = self._turn()
        self.set("providers", (*self._list(), provider))
        self.set("place", provider, self._place(provider)._replace(number=len(self._list())))
        self.log("Online", provider)
        if turn.provider == NOBODY:
            self.set("place", provider, self._place(provider)._replace(next=provider, previous=provider))
            turn = self._begin(turn, provider)._replace(keep_alive=self.run.block)
        else:
            last = self._place(turn.provider).previous
            self._link(provider, last)
            if last == turn.provider:
                turn = self._shorten_silence(turn)
        self.set("turn", turn)

    def _take(self, turn: ModelTurn) -> ModelTurn:
        if not self.indexOf(self.sender):
            raise refused("NotAProvider", self.sender)
        if not self._may_take(turn, self.sender):
            raise refused("NotYourTurn", turn.provider, turn.quota)
        following = self._place(turn.provider).next
        if self.sender != following:
            self._unlink(self.sender)
            self._link(self.sender, following)
        return self._begin(turn, self.sender)

    def _may_take(self, turn: ModelTurn, provider: bytes) -> bool:
        if turn.provider == provider:
            return True
        passed = self._timeouts(turn)
        return passed > 1 or (passed > 0 and self._place(turn.provider).next == provider)

    def _timeouts(self, turn: ModelTurn) -> int:
        silence = self.run.block - turn.keep_alive
        return (silence - 1) // self.timeoutInBlocks() if silence > 0 else 0

    def _shorten_silence(self, turn: ModelTurn) -> ModelTurn:
        if self._timeouts(turn) > 1:
            return turn._replace(keep_alive=self.run.block - self.timeoutInBlocks())
        return turn

    def _begin(self, turn: ModelTurn, provider: bytes) -> ModelTurn:
        begun = turn._replace(provider=provider, quota=self.quotaOf(provider))
        self.log("Current", provider, begun.quota)
        return begun

    def _link(self, provider: bytes, previous: bytes) -> None:
        following = self._place(previous).next
        self.set("place", provider, self._place(provider)._replace(previous=previous, next=following))
        self.set("place", previous, self._place(previous)._replace(next=provider))
        self.set("place", following, self._place(following)._replace(previous=provider))

    def _unlink(self, provider: bytes) -> None:
        following, _, previous = self._place(provider)
        self.set("place", previous, self._place(previous)._replace(next=following))
        self.set("place", following, self._place(following)._replace(previous=previous))

    def _unlist(self, index: int) -> None:
        listed = list(self._list())
        last = listed[-1]
        listed[index - 1] = last
        self.set("place", last, self._place(last)._replace(number=index))
        self.set("providers", tuple(listed[:-1]))


class ModelLighthouse(ModelTurns):
    """A lighthouse."""

    def factory(self) -> bytes:
        return bytes(self.get("factory"))

    def xrt(self) -> bytes:
        return bytes(self.get("xrt"))

    def name(self) -> bytes:
        return bytes(self.get("name"))

    def createLiability(self, demand: bytes, offer: bytes) -> bool:
        self._use_turn()
        self.run.call(self.address, self.factory(), self.data + self.sender)
        return True

    def createLiabilityWithPermit(
        self, demand: bytes, offer: bytes, value: int, deadline: int, v: int, r: bytes, s: bytes
    ) -> bool:
        return self.createLiability(demand, offer)

    def finalizeLiability(self, liability: bytes, result: bytes, success: bool, signature: bytes) -> bool:
        self._use_turn()
        self.run.call(self.address, self.factory(), self.data + self.sender)
        return True

    def to(self, liability: bytes, data: bytes) -> bool:
        if data[:4].ljust(4, b"\0") != FINALIZE:
            raise refused("OnlyFinalize")
        if len(data) < 4:
            raise ModelRevert
        result, success, signature = _read_finalize(data[4:])
        self._use_turn()
        types = ("address", "bytes", "bool", "bytes")
        call = FINALIZE_LIABILITY + encode(types, (liability, result, success, signature))
        self.run.call(self.address, self.factory(), call + self.sender)
        return True

    def refill(self, value: int) -> bool:
        self._set_stake(self.sender, checked(self.stakes(self.sender) + value))
        ModelToken(self.run, self.xrt(), self.address).transferFrom(self.sender, self.address, value)
        return True

    def withdraw(self, value: int) -> bool:
        if not self.indexOf(self.sender):
            raise refused("NotAProvider", self.sender)
        stake = self.stakes(self.sender)
        if value > stake:
            raise refused("InsufficientStake", stake, value)
        if stake - value < self.minimalStake():
            value = stake
            self._leave(self.sender)
        else:
            self._set_stake(self.sender, stake - value)
        ModelToken(self.run, self.xrt(), self.address).transfer(self.sender, value)
        return True

    def members(self, index: int) -> bytes:
        return self.providers(index)

    def membersLength(self) -> int:
        return self.providersLength()

    def balances(self, provider: bytes) -> int:
        return self.stakes(provider)

    def minimalFreeze(self) -> int:
        return self.minimalStake()

    def timeoutBlocks(self) -> int:
        return self.timeoutInBlocks()

    def keepaliveBlock(self) -> int:
        return self.keepAliveBlock()


def _read_finalize(arguments: bytes) -> tuple[bytes, bool, bytes]:
    """The result, success and signature of a canonical `finalize(bytes,bool,bytes,bool)`."""
    if len(arguments) != 352:
        raise refused("MalformedResult")

    def at(offset: int) -> int:
        return int.from_bytes(arguments[offset : offset + 32], "big")

    if not (at(0) == 128 and at(32) <= 1 and at(64) == 224 and at(128) == 34 and at(224) == 65):
        raise refused("MalformedResult")
    return arguments[160:194], at(32) == 1, arguments[256:321]
