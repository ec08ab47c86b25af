from mesh.testing._fake_job import FakeJob as FakeJob, run as run
from mesh.testing._market import Market as Market, MarketChain as MarketChain
from mesh.testing._outcomes import (
    JobRecording as JobRecording,
    RecordedOutcome as RecordedOutcome,
    assert_declined as assert_declined,
    assert_paid as assert_paid,
    assert_refunded as assert_refunded,
    judge as judge,
)
