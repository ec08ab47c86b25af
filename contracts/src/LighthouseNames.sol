// SPDX-License-Identifier: Apache-2.0
pragma solidity ^0.8.28;

import {RegistrationErrors} from "./Errors.sol";
import {IENS} from "./IENS.sol";

/// @title The ENS names of lighthouses: `NAME.lighthouse.3.robonomics.eth` and `NAME.lighthouse.5.robonomics.eth`.
/// @notice Both generations' clients find the same lighthouse. The factory owns the parents and gives each lighthouse
/// its two names, which the lighthouse keeps for ever.
abstract contract LighthouseNames is RegistrationErrors {
    /// namehash of lighthouse.3.robonomics.eth
    bytes32 private constant THIRD = 0x87bd923a85f096b00a4a347fb56cef68e95319b3d9dae1dff59259db094afd02;
    /// namehash of lighthouse.5.robonomics.eth
    bytes32 private constant FIFTH = 0x8d6c004b56cbe83bbfd9dcbd8f45d1f76398267bbb130a4629d822abc1994b96;

    /// @notice The registry in which the names are.
    IENS public immutable ens;

    constructor(IENS ens_) {
        ens = ens_;
    }

    /// @param name one ENS label, refused when a lighthouse has it: a name is always taken below both parents at once.
    function _requireFree(string calldata name) internal view {
        if (!_isLabel(bytes(name))) revert InvalidName(name);
        bytes32 node = keccak256(abi.encodePacked(FIFTH, keccak256(bytes(name))));
        if (ens.owner(node) != address(0)) revert NameTaken(name);
    }

    function _give(string calldata name, address lighthouse) internal {
        bytes32 label = keccak256(bytes(name));
        address resolver = ens.resolver(FIFTH);
        ens.setSubnodeRecord(THIRD, label, lighthouse, resolver, 0);
        ens.setSubnodeRecord(FIFTH, label, lighthouse, resolver, 0);
    }

    /// Only what every ENS client leaves as it is when it normalises a name (UTS 46, as eth-ens-namehash does), and no
    /// dots, which would hide the name. Two hyphens after two letters are for encoded names, such as `xn--`.
    function _isLabel(bytes calldata name) private pure returns (bool) {
        if (name.length == 0 || name.length > 32) return false;
        if (name[0] == "-" || name[name.length - 1] == "-") return false;
        if (name.length > 3 && name[2] == "-" && name[3] == "-") return false;
        for (uint256 i = 0; i < name.length; ++i) {
            bytes1 letter = name[i];
            bool known = (letter >= "a" && letter <= "z") || (letter >= "0" && letter <= "9") || letter == "-";
            if (!known) return false;
        }
        return true;
    }
}
