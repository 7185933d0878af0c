"""The language of the bus, shared by the HAL and the simulated devices: tables, codecs, units, the firmware's law."""
