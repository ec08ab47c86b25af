from mesh.network.channel import Channel as Channel, PresentAgents as PresentAgents, Subscription as Subscription
from mesh.network.endpoints import Endpoints as Endpoints
from mesh.network.locators import free_endpoint as free_endpoint
from mesh.network.pump import Pump as Pump, PumpLimits as PumpLimits, ResentConversion as ResentConversion
from mesh.network.readings import Reading as Reading, ReadingSubscription as ReadingSubscription
from mesh.network.services import (
    ServiceFailed as ServiceFailed,
    Services as Services,
    call as call,
    no_answer as no_answer,
)
from mesh.network.session import Network as Network, NetworkChange as NetworkChange
from mesh.network.tls import Tls as Tls
from mesh.network._validation import (
    MarketRules as MarketRules,
    MessageValidator as MessageValidator,
    ValidationStatistics as ValidationStatistics,
    message_key as message_key,
)
