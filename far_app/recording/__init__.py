"""Sessions on disk: append-only, crash-safe, self-describing. The schema is described in recordings/README.md.

writer          SessionWriter: what the 30 Hz loop hands over, in a thread of its own
reader          read_session: the typed values again, and what is missing or damaged
attempt_reader  read_attempt: the same of one attempt's file
inspect         inspect_session: what a session holds, for `far inspect`
replay          one .rrd for each attempt and the rerun viewer, for `far replay`
"""
