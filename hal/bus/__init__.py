"""CAN buses: the virtual bus, its python-can plugin, and ports that carry packets of frames."""
