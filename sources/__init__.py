"""Where readings come from: CAN buses, recordings, tables and simulators."""
