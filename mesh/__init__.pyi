from mesh.agent.agent import Agent as Agent, ModelUnfit as ModelUnfit
from mesh.agent._answers import Answer as Answer, Unanswered as Unanswered
from mesh.agent.contracts import (
    Contract as Contract,
    LiabilityReverted as LiabilityReverted,
    Outcome as Outcome,
    Progress as Progress,
)
from mesh.agent.handlers import Declined as Declined, Job as Job, JobFailed as JobFailed
from mesh.agent.hiring import DemandDeclined as DemandDeclined
from mesh.agent.ledger import Phase as Phase, WrongPhase as WrongPhase
from mesh.agent.objectives import ObjectiveNotFetched as ObjectiveNotFetched, ObjectiveUnfit as ObjectiveUnfit
from mesh.agent.orders import (
    OrderClosed as OrderClosed,
    OrderExpired as OrderExpired,
    OrderState as OrderState,
    OtherRobot as OtherRobot,
    TooManyOffers as TooManyOffers,
)
from mesh.agent.trade import Order as Order
from mesh.agent.validators import AnnouncedValidator as AnnouncedValidator, ValidatorSilent as ValidatorSilent
from mesh.amounts import XRT as XRT
from mesh.chain import (
    InsufficientTokens as InsufficientTokens,
    NodeUnreachable as NodeUnreachable,
    NotALiability as NotALiability,
)
from mesh.chain._validators import UnsafeValidator as UnsafeValidator
from mesh.content import ContentUnavailable as ContentUnavailable
from mesh.errors import (
    AiraError as AiraError,
    ChainError as ChainError,
    ClosedError as ClosedError,
    ConfigurationError as ConfigurationError,
    ContentError as ContentError,
    InputError as InputError,
    NetworkUnavailable as NetworkUnavailable,
    RemoteError as RemoteError,
)
from mesh.network import Reading as Reading
from mesh.recording import (
    Objective as Objective,
    Played as Played,
    Recorder as Recorder,
    RecordingAbout as RecordingAbout,
    foxglove as foxglove,
    open_objective as open_objective,
    pack as pack,
    pack_values as pack_values,
)
from mesh.recording.ros import RosTypes as RosTypes, UnknownRosType as UnknownRosType
from mesh.role.running import fail as fail, run_to_end as run_to_end, run_until_stopped as run_until_stopped
from mesh.settings import Settings as Settings
from mesh.validator.judging import Evidence as Evidence
from mesh.validator.validator import Validator as Validator
from mesh.validator.verification import Finding as Finding
from mesh.watching.robots import Robot as Robot
from schemas import (
    STRING as STRING,
    ZERO_ADDRESS as ZERO_ADDRESS,
    Demand as Demand,
    Empty as Empty,
    InvalidPayload as InvalidPayload,
    Liability as Liability,
    Offer as Offer,
    Payload as Payload,
    PayloadType as PayloadType,
    Result as Result,
    String as String,
    Verified as Verified,
    cid_of_file as cid_of_file,
)
from schemas.model import (
    InvalidDescription as InvalidDescription,
    ModelDescription as ModelDescription,
    ModelLimits as ModelLimits,
    ModelTopic as ModelTopic,
    ValueSchema as ValueSchema,
)
from schemas.rpc import Quote as Quote, QuoteRequest as QuoteRequest
from schemas.verdicts import (
    PolicyNote as PolicyNote,
    ReportFinding as ReportFinding,
    ValidatorAnnouncement as ValidatorAnnouncement,
    ValidatorReport as ValidatorReport,
)

__version__: str
