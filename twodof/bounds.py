"""Limits on untrusted files: sizes in bytes, processor times in s. The limits of URDFs are in ``plant/urdf.py``."""

KIB, MIB = 1024, 1024**2
MAX_NUMBER = 1e300  # in a sweep: differences of larger numbers overflow

# zip archives
MAX_ARCHIVE = 2048 * MIB
MAX_DIRECTORY = 4 * MIB  # bytes of the list of members
MAX_MEMBERS = 10_000  # files and folders, each of which takes milliseconds to unzip
MAX_UNZIPPED = 2048 * MIB
MAX_FOLDERS_DEEP = 50  # nested folders

# FMUs
MAX_DESCRIPTION = 8 * MIB  # some 50,000 variables; also structure, parameter sets and mappings of a system together
MAX_ELEMENTS = 50_000  # elements of all arrays of FMI 3.0, including aliases
MAX_NAMES = 8 * MIB  # all names of array elements together
MAX_NAME = 1000  # characters of a name, and of a text that variables share
MAX_DISPLAY_UNITS = 100  # of a unit
MAX_DIMENSIONS = 16  # dimensions of an array of FMI 3.0; a matrix has 2
MAX_COMPONENTS = 100  # FMUs and nested systems of a system, and connections in a chain
MAX_DESCRIPTIONS = 16 * MIB  # descriptions of all components of a system
MAX_FMUS = 512 * MIB  # all FMUs of a system, which a check reads several times
MAX_VARIABLES = 200_000  # variables of all components of a system; start values of a run
MAX_FILES = 50_000  # files in all FMUs of a system, or in all folders of meshes of a bag
MAX_WIRING = 1_000_000  # connections on the paths of all values of a system, and direct dependencies of its outputs
MAX_RESOURCE = 256 * MIB
MAX_WRAPPER = 16 * MIB  # pythonfmu's library; it has 0.3 MiB
MAX_SOURCES = 128 * MIB  # C files that are compiled for a page; those of a Panda have 11 MiB
MAX_START_WAIT = 600  # s of wall time, the imports of a process that checks an FMU
MAX_CALL_WAIT = 60  # s of wall time, one call of an FMU under check
MAX_CHECK_MEMORY = 4096 * MIB  # address space of an FMU under check; a Python FMU takes 0.5 GiB, more on many cores
MAX_REFERENCES = 16 * MIB  # reference files in an FMU; a file counts for each time that it is read
MAX_ROW = 64 * KIB  # a message of the checking process
MIN_STEP = 1e-6  # s, communication step: a run with a step of 1e-300 s would never end

# robots
MAX_XACRO_MEMORY = 1024 * MIB  # address space
MAX_XACRO_SECONDS = 8
MAX_XACRO_WAIT = 300  # s of wall time; on a busy machine the limit of processor time comes first

# sources in an FMU, compiled for a page
MAX_COMPILER_MEMORY = 4096 * MIB  # address space of one process; tiago_dual takes 0.3 GiB of memory
MAX_COMPILER_SECONDS = 300  # of one process; tiago_dual takes 9
MAX_COMPILER_WAIT = 600  # s of wall time
MAX_COMPILER_FILE = 64 * MIB  # a file that it writes; the module of tiago_dual has 2
MAX_COMPILER_TEXT = 1 * MIB  # its messages

# meshes of one robot
MAX_MESHES = 256 * MIB  # all files together
MAX_PATH = 4096  # characters of a file's name
MAX_LIBRARIES = 100  # material libraries of an OBJ file
MAX_TRIANGLES = 2_000_000  # in one picture; a Panda has 135,000
MAX_SURFACES = 10_000  # surfaces in one picture; each has one colour
MAX_MESH_MEMORY = 1024 * MIB  # address space of a reader
MAX_MESH_SECONDS = 5  # one mesh
MAX_MESHES_SECONDS = 30  # one reader process
MAX_MESH_WAIT = 300  # s of wall time, one mesh; on a busy machine the limit of processor time comes first
MAX_FATAL_MESHES = 3  # meshes that may crash their reader before the remaining ones are omitted

# inputs over time
MAX_TABLE = 64 * MIB  # a CSV file
MAX_CELLS = 1_000_000  # cells of a CSV, stored in the bag's run.json; also cells of all references in an FMU
MAX_COMMANDS = 1_000_000  # messages of a bag
MAX_FREE_COMMANDS = 100_000  # of these, whatever the bag's size; 8 s
MIN_COMMAND_PACKED = 20  # bytes of the bag for each further one
TRAJECTORY = 4  # messages as which a trajectory counts, because of its time
MAX_COMMAND = 64 * KIB  # a message; some thousand joints, read within milliseconds
MAX_COMMANDS_SIZE = 384 * MIB  # all of these messages in memory
MAX_POINTS = 250_000  # points of all trajectories in a bag; a further point of one takes 40 µs
MAX_FOLLOWED = 10_000_000  # input values in all steps of trajectories, where a step counts as CHANGE more; 600 MiB
MAX_TRAJECTORY = 4 * MIB  # a message; some ten thousand points, read within a second

# bags
MAX_TOPICS = 1000
MAX_ROBOTS = 32  # robots of a bag that are read together; each reads the bag
MAX_CHUNK = 256 * MIB  # a chunk or message; writers cut chunks at 1 to 4 MiB
MAX_RATIO = 1000  # ratio of unpacked to packed size; an arm at rest reaches 24, a robot of 50 joints 220
MAX_HOLLOW = 100  # ratio of a file's size to its size on the disk; file systems that compress reach 30
MAX_COPY = 1024 * MIB  # messages that a recovery or an export writes, besides MAX_COPY_RATIO times the bag's size
MAX_COPY_RATIO = 250  # ratio of these messages to the size of the bag; a robot of 50 joints at rest reaches 220
MAX_SUMMARY = 64 * MIB
MAX_METADATA = 64 * MIB
MAX_PROVENANCE = 32 * MIB  # run.json: a reader of JSON takes 15 times as much memory
MAX_PROVENANCES = 64 * MIB  # run.json files of all robots of a bag, which a recovery keeps in memory
MAX_HELD = 5_000_000  # input values, summed over all changes of inputs
CHANGE = 8  # input values as which a change of inputs counts in addition to its own, because of its memory
MAX_JOINT_STATE = 64 * KIB  # a message; a thousand joints
MAX_ODD = 128 * MIB  # joint states that differ in frame, byte order or padding, and ODD for each, which takes seconds
ODD = 600  # bytes; 20 µs
MAX_SAMPLES = 2048 * MIB  # joint states in memory; a day of 7 joints at 100 Hz takes 1450 MiB
MAX_SAMPLES_RATIO = 50  # ratio of joint states in memory beyond MAX_DRAWN to the bag's size; an arm at rest reaches 12
MAX_DRAWN = 128 * MIB  # joint states in memory from which samples to draw are chosen
MAX_COMPARED_SIZE = 256 * MIB  # joint states of several bags in one figure; an hour of 7 joints at 100 Hz takes 60
MAX_LOOSE = 16 * MIB  # records outside chunks that are read at a time, apart from one large record
MAX_VALUE = 1e100  # largest value of a sample that is judged, fitted or drawn: squares of much larger ones overflow
MAX_PROFILES = 64 * KIB  # different QoS profiles of all topics, in YAML, which is slow to parse
MAX_WRITTEN_PROFILES = 256 * KIB  # QoS profiles of all topics as metadata.yaml states them, which readers parse too
MAX_DEFINITION = 64 * KIB  # a message type
MAX_DEFINITIONS = 256 * KIB  # all message types without a stored hash; hashing 64 KiB takes a second

# sweeps
MAX_RUNS = 1_000_000
MAX_VARIED = 300  # varied variables; a figure takes 0.03 s for each
MAX_SETTINGS = 10_000
MAX_SWEEP = 256 * MIB  # table in memory, four times while it is read: a million runs of 16 varied variables

# figures and pages
MAX_PANELS = 256  # of a figure; Matplotlib takes 0.15 s for one
MAX_FRAMES = 200_000  # of a film, some hours of work
MAX_STYLES = 1 * MIB  # a matplotlibrc in the working directory; matplotlib's own has 43 KB
MAX_HEAD = 64 * KIB  # beginning of a file that identifies a page
