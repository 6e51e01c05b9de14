"""Studies of installed packages: found, collected by name, and what is refused."""

from __future__ import annotations

import pytest
from click.testing import CliRunner
from ortho_studies import studies

from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError, PluginError

DECLARED = """
from ortho_studies.hookspecs import Study, hookimpl

@hookimpl
def ortho_studies():
    {offer}
"""


@pytest.fixture
def offered(install):
    """Return a function that installs a package with a study; studies are looked for anew."""

    def added(offer, source=DECLARED, group="ortho_studies"):
        install("third-party", "third_party", source.format(offer=offer), group=group)
        studies.studies.cache_clear()

    yield added
    studies.studies.cache_clear()


def test_studies_of_packages_are_commands_beside_the_four_papers(offered):
    offered("yield Study('mine', 'A scene of mine', lambda folder, *, seed: None)")
    assert list(studies.studies()) == ["bilsat", "cartosat", "ikonos", "mine", "orbview3"]
    listed = {group: CliRunner().invoke(cli, [group, "--help"]).stdout for group in ("simulate", "reproduce")}
    assert "\n  mine      A scene of mine\n" in listed["simulate"]
    assert "mine" not in listed["reproduce"]
    assert all(f"\n  {name} " in text for text in listed.values() for name in ("bilsat", "orbview3"))


@pytest.mark.parametrize(
    ("offer", "message"),
    [
        ("yield 3", "yields int, not Study"),
        ("yield Study('mine', ''); yield Study('mine', '')", "the study 'mine' twice"),
        ("return None", "ortho_studies returned NoneType"),
        ("yield Study('ikonos', '')", "the study 'ikonos', but this name belongs to ortho-pipeline"),
    ],
)
def test_studies_that_are_none_name_their_plugin(offered, offer, message):
    offered(offer)
    with pytest.raises(PluginError, match=rf"plugin third_party \(third-party 1.2\).* {message}"):
        studies.studies()


@pytest.mark.parametrize(
    ("word", "other", "message"),
    [
        ("ortho_studies():", "ortho_study():", r"unknown hook 'ortho_study'(.|\n)*did you mean ortho_studies\?"),
        ("from ortho_studies.hookspecs import Study, hookimpl", "from ortho_pipeline.hookspecs import hookimpl",
         r"ortho_studies has no decorator @hookimpl\n.*@hookimpl .from ortho_studies\.hookspecs"),
    ],
)  # fmt: skip
def test_a_hook_that_nobody_calls_is_an_error(offered, word, other, message):
    offered("yield", source=DECLARED.replace(word, other))
    with pytest.raises(PluginError, match=message):
        studies.studies()


def test_what_is_no_study_is_refused_with_those_that_there_are(tmp_path):
    with pytest.raises(InputError, match=r"use one of: bilsat, cartosat, ikonos, orbview3"):
        studies.simulate("landsat", tmp_path)
    with pytest.raises(InputError, match=r"no option 'tilt'.*off_nadir"):
        studies.simulate("bilsat", tmp_path, tilt=3)
    assert not list(tmp_path.iterdir())
