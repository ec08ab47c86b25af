// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {Clone} from "./Clone.sol";
import {RobonomicsErrors} from "./Errors.sol";
import {IValidator} from "./IValidator.sol";
import {Orders} from "./Orders.sol";
import {Terms, TermsCode} from "./Terms.sol";

/// @notice What a liability asks of the factory.
interface ILiabilityFactory {
    function refundDelay() external view returns (uint256);
    function finalizeByValidator(
        address validator,
        bytes calldata result,
        bool success,
        bytes calldata signature,
        bool agree
    ) external;
}

/// @title A contract between promisee and promisor: one piece of work, its price and its result.
/// @notice This is the implementation behind the clones. A clone's terms are its code, so they cannot change; the one
/// thing it stores is its end. Money is held by the factory.
contract Liability is RobonomicsErrors {
    /// The mark of an end without a result where a failed result would be; no digest is that small.
    bytes32 private constant REFUNDED = bytes32(uint256(1));

    /// @notice The factory that makes liabilities and holds what they cost.
    address public immutable factory;
    address private immutable _xrt;

    /// Digest of the result of work that was paid for. The slot in which a digest lies says how the work ended, so that
    /// result and success cost one write.
    bytes32 private _succeeded;
    /// Digest of the result of work that was not paid for.
    bytes32 private _failed;

    /// @notice The end: with the promisor paid (`success`) or the promisee refunded. `result` is the multihash, empty
    /// when there is none: after a refund or a cancellation.
    event Finalized(bool indexed success, bytes result);

    /// @dev Made by the factory's constructor.
    constructor(address xrt) {
        factory = msg.sender;
        // slither-disable-next-line missing-zero-check (the factory's own)
        _xrt = xrt;
    }

    modifier onlyFactory() {
        if (msg.sender != factory) revert NotTheFactory(msg.sender);
        _;
    }

    /// @notice Generation 3 with a validator: the validator's verdict on a result that the promisor has signed. Other
    /// liabilities are finalized through their lighthouse.
    /// @param agree the promisor is paid when both `success` and `agree` are true.
    function finalize(bytes calldata result_, bool success, bytes calldata signature, bool agree)
        external
        returns (bool)
    {
        ILiabilityFactory(factory).finalizeByValidator(msg.sender, result_, success, signature, agree);
        return true;
    }

    /// @notice Ends the liability, once; the factory pays.
    /// @dev Functions are looked up in the order of their selectors, and few come before this name's.
    /// @param digest sha2-256 of the result, zero when there is none.
    function settleByFactory(bytes32 digest, bool success) external onlyFactory {
        if (isFinalized()) revert AlreadyFinalized(address(this));
        if (success) _succeeded = digest;
        else _failed = digest == 0 ? REFUNDED : digest;
        emit Finalized(success, digest == 0 ? bytes("") : _multihash(digest));
    }

    /// @notice Asks the validator about a signer in the liability's own name, as generation 5's validators expect.
    function askValidator(address validator_, address signer) external onlyFactory {
        if (!IValidator(validator_).isValidator(signer)) revert RefusedByValidator(signer);
    }

    /// @notice Multihash (34 bytes, CIDv0) of the model of the robot's behaviour.
    function model() external view returns (bytes memory) {
        return _multihash(_terms().model);
    }

    /// @notice Multihash of the parameters of the work.
    function objective() external view returns (bytes memory) {
        return _multihash(_terms().objective);
    }

    /// @notice Multihash of the result; empty before the end, and after a refund or a cancellation.
    function result() public view returns (bytes memory) {
        bytes32 digest = isSuccess() ? _succeeded : _failed;
        return uint256(digest) <= uint256(REFUNDED) ? bytes("") : _multihash(digest);
    }

    /// @notice The ERC-20 token that pays `cost`.
    function token() external view returns (address) {
        return _terms().token;
    }

    /// @notice The price, in the token's smallest unit.
    function cost() external view returns (uint256) {
        return _terms().cost;
    }

    /// @notice What the promisor paid to the provider, in wn.
    function lighthouseFee() external view returns (uint256) {
        return _terms().lighthouseFee;
    }

    /// @notice What the promisee pays to the validator, in wn.
    function validatorFee() external view returns (uint256) {
        return _terms().validatorFee;
    }

    /// @notice What the promisee has signed.
    function demandHash() external view returns (bytes32) {
        Terms memory terms = _terms();
        if (terms.generation == 3) return terms.demandHash;
        return keccak256(
            abi.encodePacked(
                _work(terms),
                terms.lighthouse,
                terms.validator,
                terms.validatorFee,
                terms.demandDeadline,
                terms.demandNonce,
                terms.promisee
            )
        );
    }

    /// @notice What the promisor has signed.
    function offerHash() external view returns (bytes32) {
        Terms memory terms = _terms();
        if (terms.generation == 3) return terms.offerHash;
        return keccak256(
            abi.encodePacked(
                _work(terms),
                terms.validator,
                terms.lighthouse,
                terms.lighthouseFee,
                terms.offerDeadline,
                terms.offerNonce,
                terms.promisor
            )
        );
    }

    /// @notice Who wants the work done and pays for it.
    function promisee() external view returns (address) {
        return _terms().promisee;
    }

    /// @notice Who does the work and is paid.
    function promisor() external view returns (address) {
        return _terms().promisor;
    }

    /// @notice The lighthouse whose providers finalize.
    function lighthouse() external view returns (address) {
        return _terms().lighthouse;
    }

    /// @notice Who judges the result; zero for nobody.
    function validator() external view returns (address) {
        return _terms().validator;
    }

    /// @notice 3 or 5: the generation of the messages it was made of.
    function generation() external view returns (uint256) {
        return _terms().generation;
    }

    /// @notice The block in which it was made.
    function createdAt() external view returns (uint256) {
        return _terms().createdAt;
    }

    /// @notice The first block in which the factory refunds the promisee when there is no result.
    function refundableFrom() external view returns (uint256) {
        return _terms().createdAt + ILiabilityFactory(factory).refundDelay();
    }

    /// @notice Whether the promisor was paid.
    function isSuccess() public view returns (bool) {
        return _succeeded != 0;
    }

    /// @notice Whether it has ended, with a result or without.
    function isFinalized() public view returns (bool) {
        return _succeeded != 0 || _failed != 0;
    }

    function _terms() private view returns (Terms memory) {
        bytes memory code = address(this).code;
        uint256 start = Clone.ARGUMENTS;
        assembly ("memory-safe") {
            start := add(add(code, 0x20), start)
        }
        return TermsCode.unpack(start, _xrt);
    }

    function _work(Terms memory terms) private pure returns (bytes memory) {
        uint16 head = uint16(Orders.MULTIHASH);
        return abi.encodePacked(head, terms.model, head, terms.objective, terms.token, terms.cost);
    }

    function _multihash(bytes32 digest) private pure returns (bytes memory) {
        return abi.encodePacked(uint16(Orders.MULTIHASH), digest);
    }
}
