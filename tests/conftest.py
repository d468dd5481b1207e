"""What holds for all tests."""

from hypothesis import HealthCheck, settings

# how long an example takes says something about the machine only
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
