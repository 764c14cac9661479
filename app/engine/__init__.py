"""The running twin: intake of events, fold, commands, status, background jobs, store and outputs."""
