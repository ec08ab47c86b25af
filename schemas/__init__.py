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
        CidKey,
        DeviceTopicKey,
        EthEventKey,
        EventKey,
        LiabilityTopicKey,
        ObjectiveTopicKey,
        ProgressKey,
        ReadingKey,
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
        DeclineKey,
        DemandKey,
        FeedbackKey,
        Key,
        OfferKey,
        PendingKey,
        PresenceKey,
        RejectKey,
        ReportKey,
        ResultKey,
        ValidatorKey,
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
    from schemas.payloads import EMPTY, JSON, RAW, STRING, Empty, Payload, PayloadType, String, payload_type
    from schemas.records import Liability, PlaybackPosition, Record
    from schemas.selectors import (
        cid_selector,
        device_selector,
        event_selector,
        lighthouse_selector,
        market_selector,
        objective_selector,
        presence_selector,
        reading_selector,
        requested_cid,
        topic_selector,
    )
    from schemas.signing import Signer, Verified, recover, verify, verify_message
    from schemas.unixfs import (
        CHUNK_SIZE,
        MAX_LINKS,
        blocks_of_stream,
        cid_of_bytes,
        cid_of_file,
        cid_of_stream,
        parse_block,
    )
    from schemas.wire import MAX_MESSAGE_SIZE, cancellation_hash, decode, encode, message_hash, order_abi

_NAMES: Final = {
    "schemas.address": (
        "ZERO_ADDRESS address_bytes checksum_address is_ens_name keccak256 parse_address parse_address_or_name"
    ),
    "schemas.agent_keys": (
        "CidKey DeviceTopicKey EthEventKey EventKey LiabilityTopicKey ObjectiveTopicKey ProgressKey ReadingKey RpcKey"
    ),
    "schemas.cid": "cid_of_digest format_cid parse_cid",
    "schemas.errors": (
        "AiraError InputError InvalidAddress InvalidCid InvalidKey InvalidMessage InvalidPayload InvalidRecord"
    ),
    "schemas.keys": (
        "DeclineKey DemandKey FeedbackKey Key OfferKey PendingKey PresenceKey RejectKey ReportKey ResultKey "
        "ValidatorKey WithdrawalKey parse_key"
    ),
    "schemas.message_fields": "MAX_UINT256",
    "schemas.messages": (
        "Demand Message Offer Order OrderFeedback Result SignedMessage TransactionFeedback Withdrawal names_in "
        "resolve_names"
    ),
    "schemas.payloads": "EMPTY Empty JSON Payload PayloadType RAW STRING String payload_type",
    "schemas.records": "Liability PlaybackPosition Record",
    "schemas.selectors": (
        "cid_selector device_selector event_selector lighthouse_selector market_selector objective_selector "
        "presence_selector reading_selector requested_cid topic_selector"
    ),
    "schemas.signing": "Signer Verified recover verify verify_message",
    "schemas.unixfs": "CHUNK_SIZE MAX_LINKS blocks_of_stream cid_of_bytes cid_of_file cid_of_stream parse_block",
    "schemas.wire": "MAX_MESSAGE_SIZE cancellation_hash decode encode message_hash order_abi",
}

# A device's agent uses keys and payloads, and must not load what signatures need.
__getattr__ = on_demand(__name__, _NAMES)
