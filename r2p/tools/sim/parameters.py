"""The parameters of a robot's modules, as the command line, files and r2p.toml give them."""

from collections.abc import Collection, Iterable
from pathlib import Path

import r2p
from r2p.codecs.parameters import Origin
from r2p.parameters.sources import ParameterSource, from_options, of_module, read_file
from r2p.sim.robots.base import EmulatedRobot
from r2p.tools.config import CONFIG, Settings, did_you_mean
from r2p.tools.session import UsageError


def parameter_sources(
    chosen: Settings, modules: Collection[str], files: Iterable[Path], options: Iterable[str]
) -> dict[str, list[ParameterSource]]:
    """Return where values of parameters come from, for each of a robot's modules. Raises UsageError.

    Options without a module are for all that have the parameter. Of several files, the last one wins.
    """
    of_modules: dict[str, list[str]] = {name: [] for name in modules}
    of_all: list[str] = []
    for option in options:
        module, found, rest = option.partition("/")
        if not found and option.partition(".")[0] in of_modules:
            raise UsageError(f"--param {option}: write it as {option.replace('.', '/', 1)}")
        if not found or "=" in module:
            of_all.append(option)
        elif module in of_modules:
            of_modules[module].append(rest)
        else:
            hint = did_you_mean(module, modules, "modules")
            raise UsageError(f"--param {option}: the robot has no module {module}; {hint}")
    try:
        shared, tables = from_options(of_all), [_of_file(path, modules) for path in reversed([*files])]
        return {
            name: [
                of_module(name, chosen.params, Origin.CONFIG, CONFIG),
                *(table[name] for table in tables),
                from_options(own),
                shared,
            ]
            for name, own in of_modules.items()
        }
    except r2p.ParameterError as error:
        raise UsageError(str(error)) from error


def _of_file(path: Path, modules: Collection[str]) -> dict[str, ParameterSource]:
    sources = {name: read_file(path, name) for name in modules}
    if not any(source.values for source in sources.values()):
        raise UsageError(f"{path} has no parameters of the robot's modules, {', '.join(modules)}")
    return sources


def check_parameters(robot: EmulatedRobot) -> None:
    """Raise UsageError for values that were given for no parameter, or that do not fit.

    All nodes have declared theirs: each runs its first step while the next module is opened.
    """
    unused: dict[str, list[str]] = {}
    for board in robot.modules.values():
        for supervisor in board.nodes.values():
            if isinstance(supervisor.error, r2p.ParameterError):
                raise UsageError(str(supervisor.error))
        for each in board.parameters.unused():
            unused.setdefault(each, []).append(board.name)
    for name, modules in unused.items():
        hint = next(filter(None, (robot.modules[each].parameters.similar(name) for each in modules)), "")
        raise UsageError(f"no node of {modules[0] if len(modules) == 1 else 'the robot'} has a parameter {name}{hint}")
