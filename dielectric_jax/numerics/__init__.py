"""Methods that know no membrane: continuation, compiled programs, codes, caches."""
