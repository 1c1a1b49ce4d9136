"""Limits on untrusted files: sizes in bytes, processor times in s; those of URDFs are in ``plant/urdf.py``."""

KIB, MIB = 1024, 1024**2

# zip archives
MAX_ARCHIVE = 2048 * MIB
MAX_DIRECTORY = 4 * MIB  # list of members
MAX_MEMBERS = 10_000  # files and folders: each takes a disk milliseconds
MAX_UNZIPPED = 2048 * MIB
MAX_FOLDERS_DEEP = 50  # folders in folders

# FMUs
MAX_DESCRIPTION = 8 * MIB  # some 50,000 variables
MAX_ELEMENTS = 50_000  # of all arrays of FMI 3.0 and of their aliases together
MAX_NAME = 1000  # characters of a variable's name
MAX_DIMENSIONS = 16  # of an array of FMI 3.0; a matrix has 2
MAX_RESOURCE = 256 * MIB
MAX_WRAPPER = 16 * MIB  # pythonfmu's library; it has 0.3 MiB
MAX_SOURCE = 16 * MIB  # a C file
MAX_CALL_WAIT = 60  # s by the clock, a call of an FMU that is checked
MAX_ROW = 64 * KIB  # a message of the process that checks it
MIN_STEP = 1e-6  # s, communication step: a run of 1e-300 has no end

# robots
MAX_XACRO_MEMORY = 1024 * MIB  # address space
MAX_XACRO_SECONDS = 8
MAX_XACRO_WAIT = 60  # s by the clock

# meshes of one robot
MAX_MESHES = 256 * MIB  # files together
MAX_TRIANGLES = 2_000_000  # drawn together; a Panda has 135,000
MAX_SURFACES = 10_000  # of one colour each, drawn together
MAX_MESH_MEMORY = 1024 * MIB  # address space of a reader
MAX_MESH_SECONDS = 5  # one mesh
MAX_MESHES_SECONDS = 30  # a reader
MAX_MESH_WAIT = 60  # s by the clock, one mesh
MAX_FATAL_MESHES = 3  # that end their reader, before the rest is left out

# inputs over time
MAX_TABLE = 64 * MIB  # a CSV file
MAX_CELLS = 1_000_000  # all of them go into the bag's run.json
MAX_COMMANDS = 1_000_000  # messages of a bag
MAX_COMMAND = 64 * KIB  # a message; some thousand joints, read within milliseconds
MAX_TRAJECTORY = 4 * MIB  # a message; some ten thousand points, read within a second

# bags
MAX_TOPICS = 1000
MAX_CHUNK = 256 * MIB  # a message too; writers cut chunks at 1 to 4 MiB
MAX_RATIO = 1000  # of unpacked to packed; an arm at rest reaches 24, one of 50 joints 220
MAX_SUMMARY = 64 * MIB
MAX_METADATA = 64 * MIB
MAX_PROVENANCE = 32 * MIB  # run.json: a reader of JSON takes 15 times as much memory
MAX_HELD = 5_000_000  # values of inputs that are in effect, over all times at which one changes
MAX_PROFILES = 64 * KIB  # all topics' different profiles, in YAML, which is slow to read
MAX_DEFINITION = 64 * KIB  # a message type

# sweeps
MAX_RUNS = 1_000_000
MAX_SWEEP = 512 * MIB  # a table in memory: a million runs with a message each

# pages
MAX_HEAD = 64 * KIB  # in which a page says that it is one
