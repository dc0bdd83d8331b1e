"""Readers of logs, one file per format; each opens a path and returns a `Table` or `ChannelLog`s."""
