// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

/// @title Why a call was refused: every custom error of the suite.
/// @notice Factory, Lighthouse and Liability all inherit these, so the ABI of any of them decodes a revert that began
/// in another. Selectors depend on names and argument types only.
interface TokenErrors {
    /// The account holds less than the transfer needs (ERC-6093).
    error ERC20InsufficientBalance(address sender, uint256 balance, uint256 needed);
    /// The spender was approved for less than the transfer needs (ERC-6093).
    error ERC20InsufficientAllowance(address spender, uint256 allowance, uint256 needed);
    /// Tokens cannot be sent to the zero address (ERC-6093).
    error ERC20InvalidReceiver(address receiver);
    /// The last second of the permit is over.
    error ERC2612ExpiredSignature(uint256 deadline);
    /// The owner has not signed this permit with its next nonce, for this token on this chain.
    error ERC2612InvalidSigner(address signer, address owner);
}

interface OrderErrors is TokenErrors {
    /// The bytes are not the canonical `abi.encode` of an order with two 34-byte `0x1220…` multihashes.
    error MalformedOrder();
    /// One order carries a nonce (generation 3), the other a sender (generation 5).
    error GenerationMismatch();
    error ModelMismatch();
    error ObjectiveMismatch();
    error TokenMismatch();
    error CostMismatch();
    error LighthouseMismatch();
    error ValidatorMismatch();
    /// The message names another lighthouse than the one that was called.
    error WrongLighthouse(address named, address called);
    /// An order is valid while `block.number < deadline`.
    error DeadlineReached(uint256 deadline);
    /// A generation-3 order makes one liability only.
    error OrderUsed(bytes32 hash);
    /// The nonce of the caller's next generation-5 order is another one.
    error WrongNonce(uint256 given, uint256 next);
    /// Not 65 bytes, `v` not 27 or 28, `s` in the upper half of the curve order, or nobody's signature.
    error InvalidSignature();
    /// Several signatures are in strictly ascending order of their signers.
    error SignersOutOfOrder(address previous, address next);
    /// The signed fields (in generation 5 also sender and nonce) are not those that were sent.
    error WrongSigner(address expected, address recovered);
    /// A generation-5 validator is asked by a call, so it has to be a contract.
    error ValidatorWithoutCode(address validator);
    /// An offer whose validator is a lighthouse is also a demand: the two have these addresses in swapped places.
    error ValidatorIsLighthouse(address validator);
    /// Only lighthouses made by this factory may call.
    error NotALighthouse(address caller);
    /// The token refused a transfer without giving a reason.
    error TokenTransferFailed(address token);
    /// The token moved another amount than it was asked to, as fee-on-transfer tokens do.
    error TokenAmountMismatch(address token, uint256 expected, uint256 received);
    /// The demand has a fee for carrying its permit, but the token's last permit of the promisee is another one.
    error FeeNotPermitted(address promisee);
}

interface LiabilityErrors {
    /// Not a liability made by this factory.
    error NotALiability(address account);
    /// A result is a 34-byte `0x1220…` multihash.
    error MalformedResult();
    error AlreadyFinalized(address liability);
    /// A generation-3 liability with a validator is finalized by that validator alone.
    error NotTheValidator(address caller);
    /// The validator contract does not accept results of this signer; several have one address (see Signatures).
    error RefusedByValidator(address signer);
    error RefundTooEarly(uint256 fromBlock);
    error NotTheFactory(address caller);
    /// No payment of this token to this account was refused, or it was claimed.
    error NothingOwed(address token, address account);
    /// A payment failed with less gas than every payment is given, so it may not have been the token that refused it.
    error TooLittleGas(uint256 left, uint256 needed);
}

interface LighthouseErrors {
    /// `to` carries `finalize(bytes,bool,bytes,bool)` and nothing else.
    error OnlyFinalize();
    error NotAProvider(address caller);
    /// It is the turn of `current`, which has `quota` transactions left.
    error NotYourTurn(address current, uint256 quota);
    error StakeTooSmall(uint256 stake, uint256 minimalStake);
    error InsufficientStake(uint256 stake, uint256 needed);
    error NoSuchProvider(uint256 index);
}

interface RegistrationErrors {
    /// A name is one ENS label: 1 to 32 of `a-z`, `0-9` and `-`, with no `-` at its ends and not two as its third and
    /// fourth letter.
    error InvalidName(string name);
    error NameTaken(string name);
    /// The minimal stake is 1 to 2^128-1 wn.
    error InvalidStake(uint256 minimalStake);
    /// The timeout is 1 to 2^32-1 blocks.
    error InvalidTimeout(uint256 timeoutInBlocks);
}

interface RobonomicsErrors is OrderErrors, LiabilityErrors, LighthouseErrors, RegistrationErrors {}
