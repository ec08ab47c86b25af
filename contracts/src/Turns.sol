// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {Clone} from "./Clone.sol";
import {LighthouseErrors} from "./Errors.sol";

/// @notice Whose turn it is.
struct Turn {
    /// Who may send transactions.
    address provider;
    /// The block of the last one.
    uint256 keepAliveBlock;
    /// How many are left.
    uint256 quota;
    /// The provider's place, counted from 1; 0 when there is no provider.
    uint256 marker;
}

/// @title Providers and their turns.
/// @notice A provider has `stake / minimalStake` transactions a turn, then the next one follows. Silence passes the
/// turn on: after each `timeoutInBlocks` one more of the providers that follow may take it. So nobody can stop a
/// lighthouse, and nobody gets another turn before each of the others has had a timeout's time to take theirs.
abstract contract Turns is LighthouseErrors {
    /// A Turn in one word: provider 160 bits, keepAliveBlock 40, quota 32, marker 24. A transaction within a turn
    /// reads and writes nothing else of the lighthouse.
    uint256 private _turn;
    address[] private _providers;

    /// @notice wn that a provider has staked.
    mapping(address provider => uint256) public stakes;
    /// @notice A provider's place, counted from 1; 0 for others.
    mapping(address provider => uint256) public indexOf;

    event Online(address indexed provider);
    event Offline(address indexed provider);
    /// @notice A turn has begun.
    event Current(address indexed provider, uint256 indexed quota);

    /// @notice Whether `provider` may send a transaction in this block.
    function isTurnOf(address provider) external view returns (bool) {
        uint256 index = indexOf[provider];
        return index != 0 && _mayTake(_load(), index);
    }

    /// @notice The provider whose turn it is; zero when there is none.
    function current() external view returns (address) {
        return _load().provider;
    }

    /// @notice Place of the provider whose turn it is, counted from 1; 0 when there is none.
    function marker() external view returns (uint256) {
        return _load().marker;
    }

    /// @notice Transactions left in this turn.
    function quota() external view returns (uint256) {
        return _load().quota;
    }

    /// @notice Block of the last transaction.
    function keepAliveBlock() public view returns (uint256) {
        return _load().keepAliveBlock;
    }

    /// @notice Transactions that a provider has in a turn.
    function quotaOf(address provider) public view returns (uint256) {
        uint256 whole = stakes[provider] / minimalStake();
        return whole < type(uint32).max ? whole : type(uint32).max;
    }

    /// @notice The provider at `index`, counted from 0.
    function providers(uint256 index) public view returns (address) {
        if (index >= _providers.length) revert NoSuchProvider(index);
        return _providers[index];
    }

    function providersLength() public view returns (uint256) {
        return _providers.length;
    }

    /// @notice wn for one transaction a turn, and the least that a provider stakes.
    function minimalStake() public view returns (uint256) {
        return uint128(bytes16(_configuration()));
    }

    /// @notice Blocks of silence after which the next provider may take the turn.
    function timeoutInBlocks() public view returns (uint256) {
        return uint32(bytes4(_configuration() << 128));
    }

    /// Counts the caller's transaction; the caller has the turn or may take it.
    function _useTurn() internal {
        Turn memory turn = _load();
        if (turn.provider != msg.sender) _take(turn);
        if (turn.quota > 1) --turn.quota;
        else _begin(turn, turn.marker % _providers.length + 1);
        turn.keepAliveBlock = block.number;
        _store(turn);
    }

    /// Sets the stake of a provider who stays, or of a new one. A turn that has begun gets no longer, but it gets
    /// shorter.
    function _setStake(address provider, uint256 stake) internal {
        if (stake < minimalStake()) revert StakeTooSmall(stake, minimalStake());
        stakes[provider] = stake;
        if (indexOf[provider] == 0) _enter(provider);
        Turn memory turn = _load();
        if (turn.provider != provider || turn.quota <= quotaOf(provider)) return;
        turn.quota = quotaOf(provider);
        _store(turn);
    }

    /// Nobody jumps the queue when a provider leaves. In his own turn it passes to the next one, and the silence so far
    /// still counts: who leaves and comes back can't keep the others waiting.
    function _leave(address provider) internal {
        uint256 index = indexOf[provider];
        uint256 last = _providers.length;
        for (uint256 place = index; place < last; ++place) _put(_providers[place], place);
        _providers.pop();
        delete indexOf[provider];
        delete stakes[provider];
        emit Offline(provider);
        if (last == 1) {
            _turn = 0;
            return;
        }
        Turn memory turn = _load();
        if (turn.marker < index) return;
        // slither-disable-next-line incorrect-equality (places in a list)
        if (turn.marker == index) _begin(turn, index < last ? index : 1);
        else --turn.marker;
        _store(turn);
    }

    /// Who comes waits until each of the others has had a turn: his place is the one before that whose turn it is.
    function _enter(address provider) private {
        Turn memory turn = _load();
        uint256 last = _providers.length + 1;
        uint256 index = turn.marker > 1 ? turn.marker : last;
        _providers.push(provider);
        for (uint256 place = last; place > index; --place) _put(_providers[place - 2], place);
        _put(provider, index);
        emit Online(provider);
        if (last == 1) {
            _begin(turn, 1);
            turn.keepAliveBlock = block.number;
        } else if (index < last) {
            ++turn.marker;
        }
        _store(turn);
    }

    /// The provider's place is now `index`, counted from 1.
    function _put(address provider, uint256 index) private {
        _providers[index - 1] = provider;
        indexOf[provider] = index;
    }

    function _take(Turn memory turn) private {
        uint256 index = indexOf[msg.sender];
        // slither-disable-next-line incorrect-equality (0 is no place in the list)
        if (index == 0) revert NotAProvider(msg.sender);
        if (!_mayTake(turn, index)) revert NotYourTurn(turn.provider, turn.quota);
        _begin(turn, index);
    }

    /// Whether so many timeouts have passed in silence as there are turns before that of the provider at `index`.
    function _mayTake(Turn memory turn, uint256 index) private view returns (bool) {
        uint256 silence = block.number - turn.keepAliveBlock;
        uint256 passed = silence > 0 ? (silence - 1) / timeoutInBlocks() : 0;
        uint256 count = _providers.length;
        return (index + count - turn.marker) % count <= passed;
    }

    /// Gives the turn, with a whole quota, to the provider at `index`, counted from 1.
    function _begin(Turn memory turn, uint256 index) private {
        turn.marker = index;
        turn.provider = _providers[index - 1];
        turn.quota = quotaOf(turn.provider);
        emit Current(turn.provider, turn.quota);
    }

    function _load() private view returns (Turn memory) {
        uint256 word = _turn;
        return Turn({
            provider: address(uint160(word >> 96)),
            keepAliveBlock: uint40(word >> 56),
            quota: uint32(word >> 24),
            marker: uint24(word)
        });
    }

    function _store(Turn memory turn) private {
        _turn = uint256(uint160(turn.provider)) << 96 | turn.keepAliveBlock << 56 | turn.quota << 24 | turn.marker;
    }

    /// minimalStake 16 bytes, timeoutInBlocks 4 bytes: what the factory put behind the proxy's code, before the name.
    function _configuration() private view returns (bytes32 word) {
        uint256 start = Clone.ARGUMENTS;
        assembly ("memory-safe") {
            extcodecopy(address(), 0, start, 32)
            word := mload(0)
        }
    }
}
