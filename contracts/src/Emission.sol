// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {Terms} from "./Terms.sol";
import {XRT} from "./XRT.sol";

/// @title What providers are paid for the gas they spend.
/// @notice Gas is counted once for each liability, when it is finalized, by a schedule of what such a liability takes
/// and not by measuring: what is measured can be inflated by whoever sends the transaction. It is paid in minted XRT,
/// and never with more than the promisee has paid to the promisor in XRT: work that moved no value mints none.
abstract contract Emission {
    /// Gas of creation and finalization together, both transactions included.
    uint256 private constant GAS_FIFTH = 224_000;
    uint256 private constant GAS_THIRD = 268_000;
    uint256 private constant GAS_COST = 51_000;
    uint256 private constant GAS_LIGHTHOUSE_FEE = 19_500;

    /// @notice The gas price in wei that the emission assumes; fixed, for a sender chooses the price of a transaction.
    uint256 public constant gasPrice = 10 gwei;

    /// @notice The token that is minted.
    XRT public immutable xrt;

    /// @notice wn that 100 units of counted gas are worth. Whoever deploys chooses it: a fork may make the same work
    /// take more gas than the schedule counts.
    uint256 public immutable wnFor100Gas;

    /// @notice Gas of all liabilities that have ended.
    uint256 public totalGasConsumed;

    constructor(XRT xrt_, uint256 wnFor100Gas_) {
        xrt = xrt_;
        wnFor100Gas = wnFor100Gas_;
    }

    /// @notice wn that this much gas is worth.
    function wnFromGas(uint256 gas) public view returns (uint256) {
        return gas * wnFor100Gas / 100;
    }

    /// @notice Generation 3's name of `totalGasConsumed`.
    function totalGasUtilizing() external view returns (uint256) {
        return totalGasConsumed;
    }

    /// Counts a liability that has ended and pays the provider who finalized it.
    /// @param provider zero when it was none: a validator, or whoever finalized without a turn or asked for a refund.
    function _credit(Terms memory terms, bool success, address provider) internal {
        uint256 gas = _gasOf(terms);
        totalGasConsumed += gas;
        bool strangers =
            terms.promisee != terms.promisor && provider != terms.promisee && provider != terms.promisor;
        if (!success || provider == address(0) || terms.token != address(xrt) || terms.cost == 0 || !strangers) return;
        uint256 wn = wnFromGas(gas);
        // slither-disable-next-line unused-return (XRT returns true or reverts)
        xrt.mint(provider, wn < terms.cost ? wn : terms.cost);
    }

    function _gasOf(Terms memory terms) internal pure returns (uint256 gas) {
        gas = terms.generation == 3 ? GAS_THIRD : GAS_FIFTH;
        if (terms.cost > 0) gas += GAS_COST;
        if (terms.lighthouseFee > 0) gas += GAS_LIGHTHOUSE_FEE;
    }
}
