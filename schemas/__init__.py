"""What travels in the mesh: messages, keys, CIDs, hashes and signatures. Pure: no network, no chain, no disk."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from schemas.loading import on_demand

if TYPE_CHECKING:
    from schemas.address import (
        ZERO_ADDRESS,
        address_bytes,
        checksum_address,
        is_ens_name,
        keccak256,
        parse_address,
        parse_address_or_name,
    )
    from schemas.agent_keys import (
        AgentKey,
        CidKey,
        DeviceTopicKey,
        EthEventKey,
        EventKey,
        LiabilityTopicKey,
        ObjectiveTopicKey,
        RpcKey,
    )
    from schemas.cid import cid_of_digest, format_cid, parse_cid
    from schemas.errors import (
        AiraError,
        InputError,
        InvalidAddress,
        InvalidCid,
        InvalidKey,
        InvalidMessage,
        InvalidPayload,
        InvalidRecord,
    )
    from schemas.keys import (
        DemandKey,
        FeedbackKey,
        Key,
        MarketKey,
        OfferKey,
        PendingKey,
        PresenceKey,
        RejectKey,
        ResultKey,
        WithdrawalKey,
        parse_key,
    )
    from schemas.message_fields import MAX_UINT256
    from schemas.messages import (
        Demand,
        Message,
        Offer,
        Order,
        OrderFeedback,
        Result,
        SignedMessage,
        TransactionFeedback,
        Withdrawal,
        names_in,
        resolve_names,
    )
    from schemas.payloads import EMPTY, JSON, RAW, STRING, Empty, PayloadType, String, payload_type
    from schemas.records import Liability, Record, UInt256
    from schemas.selectors import (
        cid_selector,
        device_selector,
        event_selector,
        lighthouse_selector,
        market_selector,
        objective_selector,
        presence_selector,
        requested_cid,
        topic_selector,
    )
    from schemas.signing import Signer, Verified, recover, verify, verify_message
    from schemas.unixfs import (
        CHUNK_SIZE,
        MAX_LINKS,
        UnixfsBlock,
        UnixfsLink,
        UnixfsNode,
        blocks_of_stream,
        cid_of_bytes,
        cid_of_file,
        cid_of_stream,
        parse_block,
    )
    from schemas.wire import MAX_MESSAGE_SIZE, cancellation_hash, decode, encode, message_hash, order_abi

_NAMES: Final = {
    "address": (
        "ZERO_ADDRESS address_bytes checksum_address is_ens_name keccak256 parse_address parse_address_or_name"
    ),
    "agent_keys": ("AgentKey CidKey DeviceTopicKey EthEventKey EventKey LiabilityTopicKey ObjectiveTopicKey RpcKey"),
    "cid": ("cid_of_digest format_cid parse_cid"),
    "errors": ("AiraError InputError InvalidAddress InvalidCid InvalidKey InvalidMessage InvalidPayload InvalidRecord"),
    "keys": (
        "DemandKey FeedbackKey Key MarketKey OfferKey PendingKey PresenceKey RejectKey ResultKey "
        "WithdrawalKey parse_key"
    ),
    "message_fields": ("MAX_UINT256"),
    "messages": (
        "Demand Message Offer Order OrderFeedback Result SignedMessage TransactionFeedback "
        "Withdrawal names_in resolve_names"
    ),
    "payloads": ("EMPTY Empty JSON PayloadType RAW STRING String payload_type"),
    "records": ("Liability Record UInt256"),
    "selectors": (
        "cid_selector device_selector event_selector lighthouse_selector market_selector objective_selector "
        "presence_selector requested_cid topic_selector"
    ),
    "signing": ("Signer Verified recover verify verify_message"),
    "unixfs": (
        "CHUNK_SIZE MAX_LINKS UnixfsBlock UnixfsLink UnixfsNode blocks_of_stream cid_of_bytes cid_of_file "
        "cid_of_stream parse_block"
    ),
    "wire": ("MAX_MESSAGE_SIZE cancellation_hash decode encode message_hash order_abi"),
}
"""The public names of each module, which is loaded when one of them is first used."""

# A device's agent uses keys and payloads, and must not load what signatures need.
__getattr__ = on_demand(
    __name__, {name: f"schemas.{module}" for module, names in _NAMES.items() for name in names.split()}
)

__all__ = [
    "CHUNK_SIZE",
    "EMPTY",
    "JSON",
    "MAX_LINKS",
    "MAX_MESSAGE_SIZE",
    "MAX_UINT256",
    "RAW",
    "STRING",
    "ZERO_ADDRESS",
    "AgentKey",
    "AiraError",
    "CidKey",
    "Demand",
    "DemandKey",
    "DeviceTopicKey",
    "Empty",
    "EthEventKey",
    "EventKey",
    "FeedbackKey",
    "InputError",
    "InvalidAddress",
    "InvalidCid",
    "InvalidKey",
    "InvalidMessage",
    "InvalidPayload",
    "InvalidRecord",
    "Key",
    "Liability",
    "LiabilityTopicKey",
    "MarketKey",
    "Message",
    "ObjectiveTopicKey",
    "Offer",
    "OfferKey",
    "Order",
    "OrderFeedback",
    "PayloadType",
    "PendingKey",
    "PresenceKey",
    "Record",
    "RejectKey",
    "Result",
    "ResultKey",
    "RpcKey",
    "SignedMessage",
    "Signer",
    "String",
    "TransactionFeedback",
    "UInt256",
    "UnixfsBlock",
    "UnixfsLink",
    "UnixfsNode",
    "Verified",
    "Withdrawal",
    "WithdrawalKey",
    "address_bytes",
    "blocks_of_stream",
    "cancellation_hash",
    "checksum_address",
    "cid_of_bytes",
    "cid_of_digest",
    "cid_of_file",
    "cid_of_stream",
    "cid_selector",
    "decode",
    "device_selector",
    "encode",
    "event_selector",
    "format_cid",
    "is_ens_name",
    "keccak256",
    "lighthouse_selector",
    "market_selector",
    "message_hash",
    "names_in",
    "objective_selector",
    "order_abi",
    "parse_address",
    "parse_address_or_name",
    "parse_block",
    "parse_cid",
    "parse_key",
    "payload_type",
    "presence_selector",
    "recover",
    "requested_cid",
    "resolve_names",
    "topic_selector",
    "verify",
    "verify_message",
]
