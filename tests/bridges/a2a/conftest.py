"""A market, a robot that drives, and a person with a policy: those of the signer's tests."""

from tests.mesh.signer.conftest import driver, folder, person

__all__ = ["driver", "folder", "person"]
