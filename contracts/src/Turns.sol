// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {Clone} from "./Clone.sol";
import {LighthouseErrors} from "./Errors.sol";

/// @notice Whose turn it is.
struct Turn {
    /// Who may send transactions.
    address provider;
    /// The block from which silence counts: that of the last transaction, or a later one.
    uint256 keepAliveBlock;
    /// How many are left.
    uint256 quota;
}

/// @notice A provider in the queue. The queue is a ring: the current provider follows the last one.
struct Place {
    address next;
    /// Where the provider is in the list, counted from 1; 0 for others.
    uint96 index;
    address previous;
}

/// @title Providers and their turns.
/// @notice A provider has `stake / minimalStake` transactions a turn, then the next one in the queue follows. After
/// `timeoutInBlocks` of silence the next one may take the turn, after twice that time anybody; then both silent ones go
/// to the end of the queue. So each new turn brings all who wait forward, but for one who had a whole timeout alone to
/// take it. Nothing here takes more gas where there are more providers.
abstract contract Turns is LighthouseErrors {
    /// A Turn in one word: provider 160 bits, keepAliveBlock 64, quota 32. A transaction within a turn reads and writes
    /// nothing else of the lighthouse.
    uint256 private _turn;
    address[] private _providers;
    mapping(address provider => Place) private _places;

    /// @notice wn that a provider has staked.
    mapping(address provider => uint256) public stakes;

    event Online(address indexed provider);
    event Offline(address indexed provider);
    /// @notice A turn has begun.
    event Current(address indexed provider, uint256 indexed quota);

    /// @notice Whether `provider` may send a transaction in this block.
    function isTurnOf(address provider) external view returns (bool) {
        return indexOf(provider) != 0 && _mayTake(_load(), provider);
    }

    /// @notice The provider whose turn it is; zero when there is none.
    function current() external view returns (address) {
        return _load().provider;
    }

    /// @notice Place in the list of the provider whose turn it is, counted from 1; 0 when there is none.
    function marker() external view returns (uint256) {
        return indexOf(_load().provider);
    }

    /// @notice Transactions left in this turn.
    function quota() external view returns (uint256) {
        return _load().quota;
    }

    /// @notice Block from which silence counts: that of the last transaction; a later one if after two timeouts of
    /// silence another provider has become the next one.
    function keepAliveBlock() public view returns (uint256) {
        return _load().keepAliveBlock;
    }

    /// @notice Transactions that a provider has in a turn.
    function quotaOf(address provider) public view returns (uint256) {
        uint256 whole = stakes[provider] / minimalStake();
        return whole < type(uint32).max ? whole : type(uint32).max;
    }

    /// @notice The provider at `index` of the list, counted from 0. The list has no order; `queue` has.
    function providers(uint256 index) public view returns (address) {
        if (index >= _providers.length) revert NoSuchProvider(index);
        return _providers[index];
    }

    function providersLength() public view returns (uint256) {
        return _providers.length;
    }

    /// @notice A provider's place in the list, counted from 1; 0 for others.
    function indexOf(address provider) public view returns (uint256) {
        return _places[provider].index;
    }

    /// @notice Up to `limit` providers and their stakes in the order of their turns.
    /// @param first where to begin; zero for the current one.
    /// @return accounts the providers.
    /// @return staked their stakes in wn.
    /// @return next where to go on; zero after the last one.
    function queue(address first, uint256 limit)
        external
        view
        returns (address[] memory accounts, uint256[] memory staked, address next)
    {
        address head = _load().provider;
        if (first == address(0)) first = head;
        if (indexOf(first) != 0) next = first;
        uint256 most = limit < _providers.length ? limit : _providers.length;
        (accounts, staked) = (new address[](most), new uint256[](most));
        uint256 found = 0;
        while (found < most && next != address(0)) {
            (accounts[found], staked[found]) = (next, stakes[next]);
            ++found;
            next = _places[next].next;
            if (next == head) next = address(0);
        }
        assembly ("memory-safe") {
            mstore(accounts, found)
            mstore(staked, found)
        }
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
        else _begin(turn, _places[turn.provider].next);
        turn.keepAliveBlock = block.number;
        _store(turn);
    }

    /// Sets the stake of a provider who stays, or of a new one. A turn that has begun gets no longer, but it gets
    /// shorter.
    function _setStake(address provider, uint256 stake) internal {
        if (stake < minimalStake()) revert StakeTooSmall(stake, minimalStake());
        stakes[provider] = stake;
        if (indexOf(provider) == 0) _enter(provider);
        Turn memory turn = _load();
        if (turn.provider != provider || turn.quota <= quotaOf(provider)) return;
        turn.quota = quotaOf(provider);
        _store(turn);
    }

    /// The others keep their order. If it is the provider's turn, the next one follows, and the silence so far still
    /// counts: who leaves and comes back can't keep the others waiting.
    function _leave(address provider) internal {
        Turn memory turn = _load();
        Place memory place = _places[provider];
        _unlist(place.index);
        _unlink(provider);
        delete _places[provider];
        delete stakes[provider];
        emit Offline(provider);
        if (_providers.length == 0) {
            _turn = 0;
            return;
        }
        if (turn.provider == provider) _begin(turn, place.next);
        else if (turn.provider != place.previous) return;
        _shortenSilence(turn);
        _store(turn);
    }

    /// Who comes goes to the end of the queue.
    function _enter(address provider) private {
        Turn memory turn = _load();
        _providers.push(provider);
        _places[provider].index = uint96(_providers.length);
        emit Online(provider);
        if (turn.provider == address(0)) {
            _places[provider].next = provider;
            _places[provider].previous = provider;
            _begin(turn, provider);
            turn.keepAliveBlock = block.number;
        } else {
            address last = _places[turn.provider].previous;
            _link(provider, last);
            if (last == turn.provider) _shortenSilence(turn);
        }
        _store(turn);
    }

    /// Gives the caller the turn. Who passes by the next one had to be silent for two timeouts: the next one, who had
    /// the second of them alone, goes to the end of the queue with the current one. Otherwise two accounts could pass
    /// the turn to each other over the heads of the rest.
    function _take(Turn memory turn) private {
        if (indexOf(msg.sender) == 0) revert NotAProvider(msg.sender);
        if (!_mayTake(turn, msg.sender)) revert NotYourTurn(turn.provider, turn.quota);
        address next = _places[turn.provider].next;
        if (msg.sender != next) {
            _unlink(msg.sender);
            _link(msg.sender, next);
        }
        _begin(turn, msg.sender);
    }

    /// Whether a provider has the turn or may take it.
    function _mayTake(Turn memory turn, address provider) private view returns (bool) {
        if (turn.provider == provider) return true;
        uint256 passed = _timeouts(turn);
        return passed > 1 || (passed > 0 && _places[turn.provider].next == provider);
    }

    /// How many timeouts have passed in silence.
    function _timeouts(Turn memory turn) private view returns (uint256) {
        uint256 silence = block.number - turn.keepAliveBlock;
        return silence > 0 ? (silence - 1) / timeoutInBlocks() : 0;
    }

    /// Who has become the next one without a new turn gets a timeout alone, as every other.
    function _shortenSilence(Turn memory turn) private view {
        if (_timeouts(turn) > 1) turn.keepAliveBlock = block.number - timeoutInBlocks();
    }

    /// Gives the turn, with a whole quota, to a provider.
    function _begin(Turn memory turn, address provider) private {
        turn.provider = provider;
        turn.quota = quotaOf(provider);
        emit Current(provider, turn.quota);
    }

    /// Puts a provider behind another one in the queue.
    function _link(address provider, address previous) private {
        address next = _places[previous].next;
        (_places[provider].previous, _places[provider].next) = (previous, next);
        (_places[previous].next, _places[next].previous) = (provider, provider);
    }

    function _unlink(address provider) private {
        (address previous, address next) = (_places[provider].previous, _places[provider].next);
        (_places[previous].next, _places[next].previous) = (next, previous);
    }

    /// Removes a place from the list; the last provider of the list moves there.
    function _unlist(uint256 index) private {
        address last = _providers[_providers.length - 1];
        _providers[index - 1] = last;
        _places[last].index = uint96(index);
        _providers.pop();
    }

    function _load() private view returns (Turn memory) {
        uint256 word = _turn;
        return Turn({
            provider: address(uint160(word >> 96)), keepAliveBlock: uint64(word >> 32), quota: uint32(word)
        });
    }

    function _store(Turn memory turn) private {
        _turn = uint256(uint160(turn.provider)) << 96 | turn.keepAliveBlock << 32 | turn.quota;
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
