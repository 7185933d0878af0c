"""The HAL: CiA 402 master, drivers, buses, safety and the cycle."""
