"""docs/identity.md says what the table of permissions says, and lists the reasons that there are."""

from __future__ import annotations

import re
from typing import get_args

from specimap_service.auth.oidc import sign_in, tokens
from specimap_service.auth.permissions_table import page_part
from tests.support.places import ROOT

PAGE = (ROOT / "docs" / "identity.md").read_text("utf-8")
SIGN_IN_PAGE = (ROOT / "web" / "src" / "signin" / "sign-in-page.tsx").read_text("utf-8")


def test_tables_are_those_that_the_program_prints() -> None:
    assert page_part() in PAGE, "print them anew: python -m specimap_service.auth.permissions_table"


def test_reasons_of_tokens_are_those_of_the_program() -> None:
    table = PAGE.partition("| reason | |")[2].partition("\n\n")[0]
    listed = {word for line in table.splitlines() for word in re.findall(r"`(\w+)`", line.partition(" | ")[0])}
    assert listed == set(get_args(tokens.Reason))


def test_reasons_of_a_sign_in_are_on_the_page_and_in_the_browser() -> None:
    for reason in (*get_args(sign_in.Reason), "identity_unavailable"):
        assert f"`{reason}`" in PAGE, reason
        assert re.search(rf"\b{reason}: ", SIGN_IN_PAGE), reason
