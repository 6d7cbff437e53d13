"""The examples in the docstrings of the module, and that everything has a docstring."""

import doctest
import inspect

import numpy as np
import pytest
import regrind
from regrind import _regrind


def documented() -> list:
    found = []
    for name, value in vars(_regrind).items():
        if name.startswith("_"):
            continue
        found.append((name, value))
        if inspect.isclass(value) and not issubclass(value, Exception):
            found += [(f"{name}.{key}", of) for key, of in vars(value).items() if not key.startswith("_")]
    return found


@pytest.mark.parametrize(("name", "value"), documented(), ids=lambda of: of if isinstance(of, str) else "")
def test_examples_give_what_they_say(name, value):
    text = inspect.getdoc(getattr(value, "__func__", value))
    assert text and len(text) > 8, name
    example = doctest.DocTestParser().get_doctest(text, {"np": np, "regrind": regrind}, name, None, None)
    result = doctest.DocTestRunner().run(example)
    assert result.failed == 0, name
    if callable(value) and not inspect.isclass(value) and name not in ("read", "write"):
        assert result.attempted or "." in name, f"{name} has no example"
