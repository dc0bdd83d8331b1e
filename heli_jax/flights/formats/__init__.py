"""Readers of logs, one file a format: each opens a path and returns a `Table` or `ChannelLog`s."""
