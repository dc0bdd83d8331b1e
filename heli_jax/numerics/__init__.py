"""Own code where a library would do, because it is measurably faster where the time goes.

Each file names the benchmark that justifies it; where that no longer shows a gain, the library's
function takes its place.
"""
