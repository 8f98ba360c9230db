"""The tuned numbers of sweeps: sizes of blocks, and limits on what is held or tried."""

__all__ = [
    "BLOCKS",
    "BLOCK_OF_CONTINUATION",
    "BLOCK_OF_SURFACE",
    "BLOCK_WITH_MORE",
    "FAMILY_FROM",
    "LONGEST_CHUNK",
    "MOST_BLOCKS",
    "MOST_DEATHS",
    "MOST_SURFACES",
    "SAME_VALUE",
    "TABLE_ROWS",
]

#: blocks that a sweep is divided into, about, within the limits below; what is not in a finished block is lost when a sweep is killed
BLOCKS = 16
#: least and most scenes of a block by continuation (a right-hand side takes 0.095 µs in 32 lanes, 0.036 in 256, `docs/benchmarks.md`)
BLOCK_OF_CONTINUATION = 32, 128
#: least and most scenes of a block on the surface, within what is quick and fits in memory
BLOCK_OF_SURFACE = 256, 8192
#: the same where curves are kept (256 states a scene) or continuation decides what is left
BLOCK_WITH_MORE = 256, 1024
#: prestretches from which their surfaces come from a family; of fewer each is built alone
FAMILY_FROM = 9
#: surfaces that a process keeps, those used last; one of more is built or read from the cache folder again
MOST_SURFACES = 8
#: blocks of a store, of each of which it keeps a file for every variable; more are refused
MOST_BLOCKS = 10**6
#: relative difference of two values of an axis that are one: 9 l and 9000 ml differ by rounding
SAME_VALUE = 1e-13
#: values of a coordinate in one chunk of a store
LONGEST_CHUNK = 1 << 20
#: scenes of a table that are held together while it is written
TABLE_ROWS = 4096
#: deaths of worker processes in succession, without a finished block between them; after more the sweep ends with an error
MOST_DEATHS = 3
