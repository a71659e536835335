"""`cli.imports`: modules are imported without a search for cycles, which goes on as it was afterwards."""

from __future__ import annotations

import gc
import sys
import types
from collections.abc import Iterator

import pytest

from filterlab.cli.imports import importing

_ANY = "a_module_of_no_one"


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    """What was frozen before stays: to unfreeze all would make every later search in this process a long one."""
    yield
    sys.modules.pop(_ANY, None)
    gc.enable()


def test_nothing_is_searched_within_and_what_was_imported_is_left_alone_afterwards() -> None:
    frozen = gc.get_freeze_count()
    with importing():
        assert not gc.isenabled()
        sys.modules[_ANY] = types.ModuleType(_ANY)
    assert gc.isenabled()
    assert gc.get_freeze_count() > frozen


def test_where_nothing_is_imported_nothing_is_frozen() -> None:
    frozen = gc.get_freeze_count()
    with importing(), importing():
        assert not gc.isenabled()
    assert gc.isenabled()
    assert gc.get_freeze_count() == frozen


def test_an_import_that_fails_leaves_the_search_as_it_was() -> None:
    frozen = gc.get_freeze_count()
    with pytest.raises(ImportError), importing():
        import_nothing()
    assert gc.isenabled()
    assert gc.get_freeze_count() == frozen


def test_who_searches_for_none_goes_on_searching_for_none() -> None:
    gc.disable()
    with importing():
        sys.modules[_ANY] = types.ModuleType(_ANY)
    assert not gc.isenabled()


def import_nothing() -> None:
    raise ImportError
