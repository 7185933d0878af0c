"""Command line, launcher, robots, scenarios, replay and reports."""
