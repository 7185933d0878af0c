"""The simulated robot: MuJoCo, drive firmware, CiA 402 devices, sensors."""
