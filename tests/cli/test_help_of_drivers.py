"""The help of an option says which drivers take it, where most do not."""

from __future__ import annotations

import pytest
import typer

from codegen.cli import main
from codegen.solving.drivers import DRIVERS

OPTIONS = ("tolerance", "time_limit", "scaling", "log")


@pytest.mark.parametrize("option", OPTIONS)
def test_help_names_the_drivers_of_an_option(option):
    command = typer.main.get_command(main).commands["solve"]
    (found,) = [parameter for parameter in command.params if parameter.name == option]
    takers = [name for name, driver in DRIVERS.items() if driver.takes("control", option)]
    assert takers
    assert all(name in found.help for name in takers), found.help
    assert not any(name in found.help for name in set(DRIVERS) - set(takers)), found.help
