//! Commands that run with changes.

/// How to run on a cluster.
pub const CLUSTER: &str = "docs/src/how-to/cluster.md";
/// How to compare cores.
pub const CORES: &str = "docs/src/how-to/cores.md";
/// How to serve many streams.
pub const STREAMS: &str = "docs/src/how-to/streams.md";
/// How to share streams between nodes.
pub const MANY_ROBOTS: &str = "docs/src/how-to/many_robots.md";
/// Where the numbers come from.
pub const NUMBERS: &str = "docs/src/background/numbers.md";

/// The written text, its replacement, and the reason. All matching entries are applied in order. `{topic}` is an unused
/// prefix, `{port}` and `{other_port}` are unused ports.
pub const CHEAPER: &[(&str, &str, &str)] = &[
    ("cargo run --release --", "eddy", "already built"),
    ("cargo run --release -p eddy-lab --", "eddy-lab", "already built"),
    (
        "simulate --preset kinds",
        "simulate --preset kinds --particles 250 --duration 0.8",
        "small scenes",
    ),
    (
        "plan.json --preset kinds",
        "plan.json --preset kinds --particles 250 --duration 0.8",
        "small scenes",
    ),
    ("--scenes 400", "--scenes 5", "one of each kind"),
    ("--scenes 96", "--scenes 5", "one of each kind"),
    ("--scenes 10 ", "--scenes 5 ", "one of each kind"),
    ("--scenes 5 --seed 2001", "--scenes 10 --seed 2001", "the fewest for a calibration"),
    ("eddy calibrate", "eddy calibrate --horizon 20", "the scenes are short"),
    ("--scenes 20", "--scenes 5", "one of each kind"),
    ("eddy train --data", "eddy train --config quick.toml --data", "a few windows an epoch"),
    ("--epochs 40", "--epochs 1", "one epoch"),
    ("--epochs 12", "--epochs 1", "one epoch"),
    ("--starts 2", "--starts 1", "one rollout a scene"),
    ("eddy eval", "eddy eval --horizon 20", "the scenes are short"),
    (
        "eddy eval --horizon 20 --compare",
        "eddy eval --compare",
        "the horizon is that of the reports",
    ),
    (
        "checkpoints/elsewhere",
        "checkpoints/particle-mingru",
        "no PyTorch here; the shipped checkpoint stands in",
    ),
    ("10.0.0.1:7447", "127.0.0.1:{port}", "no router is running"),
    (r#"mode="client";"#, "", "a client does not start without its router"),
    ("--preset snowball --publish", "--preset snowball --duration 0.5 --publish", "a short scene"),
    ("eddy demo", "eddy demo --headless --seconds 1", "a short scene"),
    ("--seconds 1 --headless --seconds 4", "--seconds 1", "a short scene"),
    ("eddy replay bags/sample --rate 0.2", "eddy replay bags/sample", "at the recorded rate"),
    (
        "--particles 2500,10000 --threads 1,2",
        "--particles 1000 --threads 1 --seconds 0.02",
        "one case",
    ),
    (
        "bench inference",
        "bench inference --device flex --particles 100 --seconds 0.02 --threads 1",
        "a short run on one device",
    ),
    ("bench training", "bench training --seconds 0.02", "a short run"),
    ("bench transport", "bench transport --messages 20", "a short run"),
    ("bench node", "bench node --seconds 0.5", "a short run"),
    (
        "bench group --nodes 10 --streams 1000",
        "bench group --nodes 2 --streams 10 --particles 50 --hertz 10 --seconds 1",
        "a short run of few nodes",
    ),
    ("--hertz 250 --seconds 15", "--hertz 250 --seconds 0.5", "a short run"),
    ("bench bag --seconds 4", "bench bag --seconds 0.1 --particles 1000", "a short run"),
    (
        "bench view --particles 100000 --seconds 4",
        "bench view --particles 250 --seconds 0.2",
        "a short run",
    ),
    ("--view 8081", "--view {port}", "unused ports"),
    ("--foxglove", "--foxglove 0", "any free port"),
    ("--view 8082", "--view {other_port}", "the same"),
    ("eddy-lab study", "eddy-lab study --config study.toml", "few steps of small networks"),
    ("--duration 10", "--duration 8", "a shorter run, which includes the search for the topic"),
    ("--wait 5", "--wait 0.2", "no other publishers"),
    ("--references mpm,chaos", "--references mpm,chaos --starts 1", "one rollout a scene"),
    (
        "--to shm",
        "--to shm --remap /particles:=/{topic}/particles",
        "shared memory is global to the machine",
    ),
    ("shm:/", "shm:/{topic}/", "the same"),
    (
        "record --all",
        "record --all --from zenoh",
        "topics of other tests in shared memory would be recorded, too",
    ),
    ("/particles:=/truth", "/particles:=/{topic}/truth", "the same"),
    ("10.0.0.1:7450", "127.0.0.1:{port}", "one machine instead of two"),
    ("10.0.0.2:7450", "127.0.0.1:{other_port}", "one machine instead of two"),
];
