"""The running twin: engine, views, page server, recorder, command line."""
