# This source code is licensed under the MIT license found in the LICENSE file.
"""Fixtures of all faults: one template of everything that can be damaged, and a folder per fault."""

import pytest
from fault_ledger import Place, make_template


@pytest.fixture(scope="session")
def template(tmp_path_factory):
    return make_template(tmp_path_factory.mktemp("template"))


@pytest.fixture
def place(template, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Place(tmp_path, template)
