"""The running twin: engine, commands, status, background jobs, revisions and tuning versions."""
