// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {Clone} from "./Clone.sol";
import {Emission} from "./Emission.sol";
import {RobonomicsErrors} from "./Errors.sol";
import {IENS} from "./IENS.sol";
import {ILiabilityFactory, Liability} from "./Liability.sol";
import {ILighthouseFactory, Lighthouse} from "./Lighthouse.sol";
import {LighthouseNames} from "./LighthouseNames.sol";
import {Order, Orders} from "./Orders.sol";
import {Permit, Permits} from "./Permits.sol";
import {PullPayments} from "./PullPayments.sol";
import {Signatures} from "./Signatures.sol";
import {Terms, TermsCode} from "./Terms.sol";
import {Tokens} from "./Tokens.sol";
import {XRT} from "./XRT.sol";

/// @title The factory: makes lighthouses and liabilities, holds what liabilities cost, and pays.
/// @notice It keeps no list of what it has made: a clone of its own is known by its code (see Clone). Money moves in
/// before a liability exists and out after it has ended, so there is no state in between for a token's hook to come
/// back to.
contract Factory is
    RobonomicsErrors,
    LighthouseNames,
    Emission,
    PullPayments,
    ILighthouseFactory,
    ILiabilityFactory
{
    using Orders for Order;

    /// Tells liabilities from lighthouses.
    bytes32 private constant LIABILITY = bytes32(uint256(1));
    /// Tells lighthouses from liabilities, and from those of other chains: orders name their lighthouse, and no chain.
    bytes32 private immutable _lighthouseKind = keccak256(abi.encode(2, block.chainid));

    /// @notice Blocks after a liability's creation until its promisee may have the money back.
    uint256 public immutable refundDelay;
    /// @notice Implementation behind the liabilities.
    address private immutable _liabilityCode;
    /// @notice Implementation behind the lighthouses.
    address private immutable _lighthouseCode;

    /// @notice Generation 5: the nonce that an account's next order is signed with.
    mapping(address account => uint256) public nonceOf;
    /// Generation 3: who used a hash first. Anybody can sign the terms of another's order, nonce and all, and must not
    /// use up the other's order by that.
    mapping(bytes32 hash => address signer) private _firstUser;
    /// The others, by the hash of both.
    mapping(bytes32 hashAndSigner => bool) private _isUsed;

    event NewLiability(address indexed liability);
    event NewLighthouse(address indexed lighthouse, string name);
    /// @notice An order has made its liability.
    event HashConsumed(bytes32 indexed hash);
    /// @notice Generation 3: no order with this hash and this signer can make a liability any more.
    event OrderWithdrawn(bytes32 indexed hash, address indexed signer);
    /// @notice Generation 5: no order with this nonce and this sender can make a liability any more.
    event NonceWithdrawn(uint256 indexed nonce, address indexed sender);

    /// @param ens_ registry in which this factory owns the parents of the lighthouses' names.
    /// @param xrt_ token that has, or will have, this factory as its minter.
    /// @param refundDelay_ in blocks; longer than any work is to take.
    /// @param wnFor100Gas_ wn that providers are paid for 100 units of gas.
    constructor(IENS ens_, XRT xrt_, uint256 refundDelay_, uint256 wnFor100Gas_)
        LighthouseNames(ens_)
        Emission(xrt_, wnFor100Gas_)
    {
        refundDelay = refundDelay_;
        _liabilityCode = address(new Liability(address(xrt_)));
        _lighthouseCode = address(new Lighthouse(xrt_));
    }

    /// @notice Makes a lighthouse and registers its names; anybody may.
    /// @param minimalStake wn for one transaction a turn.
    /// @param timeoutInBlocks silence after which the turn passes on.
    /// @param name ENS label: 1 to 32 of `a-z`, `0-9` and `-` (see InvalidName).
    function createLighthouse(uint256 minimalStake, uint256 timeoutInBlocks, string calldata name)
        external
        returns (address lighthouse)
    {
        if (minimalStake == 0 || minimalStake > type(uint128).max) revert InvalidStake(minimalStake);
        if (timeoutInBlocks == 0 || timeoutInBlocks > type(uint32).max) revert InvalidTimeout(timeoutInBlocks);
        _requireFree(name);
        bytes memory arguments = abi.encodePacked(uint128(minimalStake), uint32(timeoutInBlocks), name);
        lighthouse = Clone.create(_lighthouseCode, _lighthouseKind, arguments);
        _give(name, lighthouse);
        // slither-disable-next-line reentrancy-events (the registry is chosen by who deploys)
        emit NewLighthouse(lighthouse, name);
    }

    /// @notice Makes a liability; for lighthouses, which add the provider's address behind the arguments.
    /// @param demand canonical ABI encoding of the promisee's order.
    /// @param offer the same of the promisor's.
    function createLiability(bytes calldata demand, bytes calldata offer) external {
        _make(_agree(Orders.read(demand), Orders.read(offer)));
    }

    /// @notice As `createLiability`, with the promisee's permit for this factory (EIP-2612), so that the promisee needs
    /// no transaction to approve the cost. If somebody has brought the permit to the token before, the approval stands.
    /// Without a validator, the demand's fee is what the promisee pays the provider for this, in the demand's token.
    /// @param value what the permit approves: the cost and the fee at least, in the token's smallest unit.
    /// @param deadline the permit's last second.
    function createLiabilityWithPermit(
        bytes calldata demand,
        bytes calldata offer,
        uint256 value,
        uint256 deadline,
        uint8 v,
        bytes32 r,
        bytes32 s
    ) external {
        Terms memory terms = _agree(Orders.read(demand), Orders.read(offer));
        Permit memory permit = Permit(value, deadline, v, r, s);
        Permits.submit(terms.token, terms.promisee, permit);
        if (terms.validator == address(0) && terms.validatorFee > 0) {
            // Elsewhere such a fee means nothing, and nobody may be charged it for an approval of another day.
            Permits.requireLast(terms.token, terms.promisee, permit);
            Tokens.take(terms.token, terms.promisee, _provider(), terms.validatorFee);
        }
        _make(terms);
    }

    /// @notice Generation 3: makes an order of the caller's unusable, whatever a provider does with it.
    /// @param hash what the caller has signed.
    function withdrawOrder(bytes32 hash) external {
        _useHash(hash, msg.sender);
        emit OrderWithdrawn(hash, msg.sender);
    }

    /// @notice Generation 5: makes all orders that the caller has signed with its current nonce unusable.
    /// @param nonce the current one; an order that makes its liability first must not cost the next one its nonce.
    function withdrawNonce(uint256 nonce) external {
        uint256 next = nonceOf[msg.sender];
        if (nonce != next) revert WrongNonce(nonce, next);
        nonceOf[msg.sender] = next + 1;
        emit NonceWithdrawn(nonce, msg.sender);
    }

    /// @notice Ends a liability; for its lighthouse, which adds the provider's address behind the arguments.
    /// @param signature 65 bytes; of several whom the validator accepts together, 65 bytes each, in ascending order of the
    /// signers.
    function finalizeLiability(address liability, bytes calldata result, bool success, bytes calldata signature)
        external
    {
        Terms memory terms = _termsOf(liability);
        if (msg.sender != terms.lighthouse) revert WrongLighthouse(terms.lighthouse, msg.sender);
        _finalize(liability, terms, result, success, signature, _provider());
    }

    /// @notice Ends a liability with a signed result, without a lighthouse and its turns; anybody may call. So nobody can
    /// keep the turn until the promisor's time is over. Nothing is minted.
    /// @param result 34-byte multihash.
    /// @param signature as for `finalizeLiability`.
    function finalize(address liability, bytes calldata result, bool success, bytes calldata signature) external {
        _finalize(liability, _termsOf(liability), result, success, signature, address(0));
    }

    /// @notice Ends a generation-3 liability with a validator; for the liability itself.
    /// @param validator who called the liability.
    function finalizeByValidator(
        address validator,
        bytes calldata result,
        bool success,
        bytes calldata signature,
        bool agree
    ) external {
        Terms memory terms = _termsOf(msg.sender);
        if (terms.generation != 3 || terms.validator != validator) revert NotTheValidator(validator);
        (bytes32 digest, bytes32 hash) = _readResult(msg.sender, result, success);
        _requireSigner(terms.promisor, Signatures.recover(hash, signature));
        _end(msg.sender, terms, digest, success && agree);
        _credit(terms, success && agree, address(0));
    }

    /// @notice Gives the promisee the money back when `refundDelay` blocks have brought no result; anybody may call.
    function refund(address liability) external {
        Terms memory terms = _termsOf(liability);
        if (block.number < terms.createdAt + refundDelay) revert RefundTooEarly(terms.createdAt + refundDelay);
        _giveBack(liability, terms);
    }

    /// @notice Gives the promisee the money back at once, for both parties want it so; anybody may call.
    /// @param promiseeSignature of keccak256 of the liability's address and the six letters "cancel", packed.
    /// @param promisorSignature of the same.
    function cancel(address liability, bytes calldata promiseeSignature, bytes calldata promisorSignature) external {
        Terms memory terms = _termsOf(liability);
        bytes32 hash = keccak256(abi.encodePacked(liability, "cancel"));
        _requireSigner(terms.promisee, Signatures.recover(hash, promiseeSignature));
        _requireSigner(terms.promisor, Signatures.recover(hash, promisorSignature));
        _giveBack(liability, terms);
    }

    /// @notice Whether this factory made the lighthouse.
    function isLighthouse(address account) public view returns (bool isClone) {
        // slither-disable-next-line unused-return (the clone's arguments are not asked for)
        (isClone,) = Clone.read(account, _lighthouseKind);
    }

    /// @notice Whether this factory made the liability.
    function isLiability(address account) public view returns (bool isClone) {
        // slither-disable-next-line unused-return (the clone's arguments are not asked for)
        (isClone,) = Clone.read(account, LIABILITY);
    }

    /// @notice Generation 3: whether an order with this hash has made its liability or was withdrawn, whoever has signed
    /// it. Generation 5 is guarded by nonces: always false.
    function isHashConsumed(bytes32 hash) external view returns (bool) {
        return _firstUser[hash] != address(0);
    }

    /// @notice Generation 3: whether the order of `signer` with this hash has made its liability or was withdrawn.
    function isOrderUsed(bytes32 hash, address signer) external view returns (bool) {
        return _firstUser[hash] == signer ? signer != address(0) : _isUsed[keccak256(abi.encode(hash, signer))];
    }

    /// @notice Gas that is counted for a liability: nothing before its end.
    function gasConsumedOf(address liability) public view returns (uint256) {
        return isLiability(liability) && Liability(liability).isFinalized() ? _gasOf(_termsOf(liability)) : 0;
    }

    /// @notice Generation 3's name of `gasConsumedOf`.
    function gasUtilizing(address liability) external view returns (uint256) {
        return gasConsumedOf(liability);
    }

    /// Checks who calls and both orders, and uses them up.
    function _agree(Order calldata demand, Order calldata offer) private returns (Terms memory terms) {
        if (!isLighthouse(msg.sender)) revert NotALighthouse(msg.sender);
        Orders.requireMatch(demand, offer);
        terms.lighthouse = address(uint160(demand.firstAccount));
        if (terms.lighthouse != msg.sender) revert WrongLighthouse(terms.lighthouse, msg.sender);
        terms.validator = address(uint160(demand.secondAccount));
        terms.generation = demand.isFifth() ? 5 : 3;
        if (terms.validator != address(0)) _checkValidator(terms);
        terms.model = demand.model();
        terms.objective = demand.objective();
        terms.token = address(uint160(demand.token));
        terms.cost = demand.cost;
        terms.validatorFee = demand.fee;
        terms.lighthouseFee = offer.fee;
        terms.createdAt = block.number;
        terms.demandDeadline = demand.deadline;
        terms.offerDeadline = offer.deadline;
        (terms.promisee, terms.demandHash, terms.demandNonce) = _use(demand);
        (terms.promisor, terms.offerHash, terms.offerNonce) = _use(offer);
    }

    /// Takes the money for what was agreed, and makes the liability.
    function _make(Terms memory terms) private {
        _collect(terms, _provider());
        address liability = Clone.create(_liabilityCode, LIABILITY, TermsCode.pack(terms, address(xrt)));
        // slither-disable-next-line reentrancy-events (nobody but the token was called, and it changes nothing here)
        emit NewLiability(liability);
    }

    /// An Offer (lighthouse L, validator V) is, with the same signature, a Demand (lighthouse V, validator L). So no
    /// validator may be a lighthouse: else a robot's offer could take the robot's tokens.
    function _checkValidator(Terms memory terms) private view {
        if (terms.generation == 5 && terms.validator.code.length == 0) revert ValidatorWithoutCode(terms.validator);
        if (isLighthouse(terms.validator)) revert ValidatorIsLighthouse(terms.validator);
    }

    /// Checks an order's deadline and signature and makes sure that it is used once.
    function _use(Order calldata order) private returns (address signer, bytes32 hash, uint256 nonce) {
        if (block.number >= order.deadline) revert DeadlineReached(order.deadline);
        if (order.isFifth()) {
            address sender = address(uint160(order.nonceOrSender));
            nonce = nonceOf[sender]++;
            hash = order.hashFifth(nonce);
            signer = order.recover(hash);
            _requireSigner(sender, signer);
        } else {
            hash = order.hashThird();
            signer = order.recover(hash);
            _useHash(hash, signer);
        }
        emit HashConsumed(hash);
    }

    /// The first signer of a hash costs one slot, as a mere flag would.
    function _useHash(bytes32 hash, address signer) private {
        address first = _firstUser[hash];
        if (first == address(0)) {
            _firstUser[hash] = signer;
            return;
        }
        bytes32 key = keccak256(abi.encode(hash, signer));
        if (first == signer || _isUsed[key]) revert OrderUsed(hash);
        _isUsed[key] = true;
    }

    /// Takes what the liability costs into the factory and pays the provider's fee. Each gives what it has signed for,
    /// and XRT returns true or reverts.
    // slither-disable-start arbitrary-send-erc20,unchecked-transfer
    function _collect(Terms memory terms, address provider) private {
        if (terms.lighthouseFee > 0) xrt.transferFrom(terms.promisor, provider, terms.lighthouseFee);
        if (terms.cost > 0) {
            if (terms.token == address(xrt)) xrt.transferFrom(terms.promisee, address(this), terms.cost);
            else Tokens.takeExactly(terms.token, terms.promisee, terms.cost);
        }
        if (_hasValidatorFee(terms)) xrt.transferFrom(terms.promisee, address(this), terms.validatorFee);
    }
    // slither-disable-end arbitrary-send-erc20,unchecked-transfer

    /// Ends the liability with a result of the promisor's or, in generation 5, of those whom the validator accepts.
    /// @param provider zero when nobody is to be credited.
    function _finalize(
        address liability,
        Terms memory terms,
        bytes calldata result,
        bool success,
        bytes calldata signature,
        address provider
    ) private {
        (bytes32 digest, bytes32 hash) = _readResult(liability, result, success);
        if (terms.validator == address(0)) {
            _requireSigner(terms.promisor, Signatures.recover(hash, signature));
        } else if (terms.generation == 3) {
            revert NotTheValidator(provider == address(0) ? msg.sender : provider);
        } else {
            Liability(liability).askValidator(terms.validator, Signatures.recoverAll(hash, signature));
        }
        _end(liability, terms, digest, success);
        _credit(terms, success, provider);
    }

    /// Ends the liability, then pays: the promisor for success, or the promisee; and the validator for judging.
    function _end(address liability, Terms memory terms, bytes32 digest, bool success) private {
        Liability(liability).settleByFactory(digest, success);
        _payOut(terms, success ? terms.promisor : terms.promisee, terms.validator);
    }

    /// Ends the liability without a result; nobody has judged anything, so the promisee gets the validator's fee too.
    function _giveBack(address liability, Terms memory terms) private {
        Liability(liability).settleByFactory(0, false);
        _payOut(terms, terms.promisee, terms.promisee);
        _credit(terms, false, address(0));
    }

    /// Pays what `_collect` has taken into the factory; for a liability that has just ended, so it comes once. XRT returns
    /// true or reverts, and refuses nobody who can have a part in a liability.
    // slither-disable-start unchecked-transfer
    function _payOut(Terms memory terms, address costTo, address feeTo) private {
        if (terms.cost > 0) {
            if (terms.token == address(xrt)) xrt.transfer(costTo, terms.cost);
            else _payOrOwe(terms.token, costTo, terms.cost);
        }
        if (_hasValidatorFee(terms)) xrt.transfer(feeTo, terms.validatorFee);
    }
    // slither-disable-end unchecked-transfer

    /// The digest of a result, and what its signer has signed.
    function _readResult(address liability, bytes calldata result, bool success)
        private
        pure
        returns (bytes32 digest, bytes32 hash)
    {
        if (result.length != 34 || uint16(bytes2(result)) != Orders.MULTIHASH) revert MalformedResult();
        digest = bytes32(result[2:]);
        // Digests that nothing has; the liability means an empty slot and a refund by them.
        if (uint256(digest) <= 1) revert MalformedResult();
        hash = keccak256(abi.encodePacked(liability, result, success));
    }

    function _termsOf(address liability) private view returns (Terms memory) {
        (bool isClone, uint256 arguments) = Clone.read(liability, LIABILITY);
        if (!isClone) revert NotALiability(liability);
        return TermsCode.unpack(arguments, address(xrt));
    }

    function _requireSigner(address expected, address signer) private pure {
        if (signer != expected) revert WrongSigner(expected, signer);
    }

    function _hasValidatorFee(Terms memory terms) private pure returns (bool) {
        return terms.validator != address(0) && terms.validatorFee > 0;
    }

    /// The account behind the lighthouse's call; only to be believed when a lighthouse is calling.
    function _provider() private pure returns (address provider) {
        assembly ("memory-safe") {
            provider := shr(96, calldataload(sub(calldatasize(), 20)))
        }
    }
}
