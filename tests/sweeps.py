"""Cases of a test that sweeps: the first one is always tried, the others with the attacks."""

import pytest


def sweep(case, *others):
    """Values for ``parametrize``; of several arguments a tuple each."""
    values = [other if isinstance(other, tuple) else (other,) for other in others]
    return [case, *(pytest.param(*each, marks=pytest.mark.attacks) for each in values)]
