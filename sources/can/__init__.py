"""CAN buses and logs of CAN frames."""
