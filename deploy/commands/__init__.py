"""The subcommands of `cosim`, one module each; every import beyond typer waits until a command runs."""
