"""Calls that must be refused."""

import pytest


def refuses(call, message, error=ValueError):
    """The call raises an error whose message contains the pattern."""
    with pytest.raises(error, match=message):
        call()
