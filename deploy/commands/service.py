"""`cosim plant`, `hal`, `controller`, `record`: one service in the foreground, to be started by hand or by systemd."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from deploy.commands import options as opt

ScenarioOption = Annotated[str, typer.Option(help="Packaged name or YAML file; the same for all services of a run.")]
Session = Annotated[str | None, typer.Option(help="Identity of the run; default: derived from scenario and seed.")]
Peers = Annotated[
    str, typer.Option(metavar="A,B,…", help="Services expected in the run; without `plant` on a real robot.")
]
EVERYONE = "plant,hal,controller,recorder"

TEXTS = {
    "plant": ("The simulated robot: MuJoCo and CiA 402 drives on the buses.", " --bus can1,can3,can5"),
    "hal": ("The hardware abstraction layer: the CANopen master of the robot.", " --bus can0,can2,can4"),
    "controller": ("The torque controller.", ""),
    "record": ("Write all messages of a run to an MCAP file.", " --output run.mcap"),
}


def register(app: typer.Typer) -> None:
    """Add the four commands."""
    for name, (text, example) in TEXTS.items():
        epilog = f"Example: cosim {name} --scenario arm9-transition --clock realtime{example}"
        app.command(name, help=text, epilog=epilog)(_command(name))


def _command(name: str) -> Callable[..., None]:
    def command(
        scenario: ScenarioOption,
        sets: opt.Set = None,
        seed: opt.Seed = None,
        duration: Annotated[float | None, typer.Option(help="Length of the run in seconds.")] = None,
        clock: opt.Clock = None,
        bus: opt.Bus = None,
        allow_overload: opt.AllowOverload = False,
        base_port: opt.BasePort = None,
        session: Session = None,
        peers: Peers = EVERYONE,
        output: Annotated[Path | None, typer.Option(help="The recorder's file; others ignore it.")] = None,
    ) -> None:
        from deploy import session as sessions
        from deploy.errors import UsageError
        from deploy.services import run_service
        from schemas.service import Service, ServiceOptions, session_identity
        from schemas.transport import TransportConfig

        run = opt.resolve_run(
            scenario, sets, seed=seed, duration_s=duration, clock=clock, bus=bus, allow_overload=allow_overload
        )
        service = Service.RECORDER if name == "record" else Service(name)
        expected = tuple(peer.strip() for peer in peers.split(",") if peer.strip())
        if unknown := [peer for peer in expected if peer not in list(Service)]:
            raise UsageError(f"--peers: unknown service {unknown[0]!r}; the services are {', '.join(Service)}")
        port = base_port if base_port is not None else TransportConfig().base_port
        if service is Service.RECORDER and output is None:
            output = Path(f"{run.scenario.name}.mcap")
        if service is Service.RECORDER and output is not None and output.exists():
            raise UsageError(f"--output {output}: exists; give another or remove it")
        choice = ServiceOptions(port, session or session_identity(run), expected, sessions.runtime_root(), output)
        note = sessions.describe(run, choice, Path.cwd())
        if service is Service.HAL:
            sessions.refuse_taken(port)
            sessions.announce(note)
        try:
            code = run_service(service, run, choice)
        finally:
            if service is Service.HAL:
                sessions.withdraw(note)
        raise typer.Exit(code)

    return command
