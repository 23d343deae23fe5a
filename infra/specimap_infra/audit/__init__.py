"""The audit trail: append-only entries that a chain of hashes holds together.

Writers add entries in their own transactions and never wait for each other. The sealer orders what has been committed
and chains it, within a second or so, under a lock on one row.
"""
