"""Completions of the shells: bash completes commands, options, choices and files as the parser knows them."""

import shutil
import subprocess
import sys

import pytest

from dielectric_jax.apps.cli import main
from dielectric_jax.apps.options import make_parser

ASK = """source {script}; cd {folder}; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
_shtab_dielectric_jax; printf '%s\\n' "${{COMPREPLY[@]}}" """


def printed(capsys, shell):
    pytest.importorskip("shtab")
    with pytest.raises(SystemExit) as end:
        main(["--print-completion", shell])
    assert not end.value.code
    return capsys.readouterr().out


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash is installed")
def test_bash_completes_what_the_parser_knows(capsys, tmp_path):
    script = tmp_path / "completion"
    script.write_text(printed(capsys, "bash"), encoding="utf-8")
    (tmp_path / "mine.toml").touch()

    def completed(*words):
        ask = ASK.format(script=script, folder=tmp_path)
        done = subprocess.run(
            ["bash", "-c", ask, "-", "dielectric-jax", *words], capture_output=True, text=True, check=True
        )
        return set(done.stdout.split())

    assert completed("vol") == {"voltage-volume"}
    assert {"equilibrium", "paper", "sweep", "follow"} <= completed("")
    assert completed("voltage-volume", "--chamber") == {"--chamber-volume"}
    assert completed("voltage-volume", "--material", "") == {
        "gent",
        "neo-hookean",
        "arruda-boyce",
        "mooney-rivlin",
        "ogden",
    }
    assert completed("follow", "mi") == {"mine.toml"}


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_every_command(capsys, shell):
    script = printed(capsys, shell)
    commands = {name for action in make_parser()._actions if action.dest == "command" for name in action.choices or ()}
    assert (
        "sweep" in commands
        and all(name in script for name in commands)
        and "many scenes, saved in a store" in script
        and "chamber-volume" in script
    )


def test_without_shtab_one_sentence_says_what_to_install(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["--print-completion", "bash"]) == 2
    assert "dielectric-jax[completion]" in capsys.readouterr().err
