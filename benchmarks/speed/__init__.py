"""How long does it take, beside its error and beside peers?"""
