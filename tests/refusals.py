"""Calls that must be refused, or must not warn."""

import warnings

import pytest


def refuses(call, message, error=ValueError):
    """The call raises an error whose message contains the pattern."""
    with pytest.raises(error, match=message):
        call()


def without_warning(call, *arguments, **options):
    """The result of a call that must not warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return call(*arguments, **options)
