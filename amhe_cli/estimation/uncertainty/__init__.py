"""How sure is an estimate: one ledger of named error terms, one file a term, and verdicts that read it."""
