//! Where the commands that run differ from those that are written, and those that do not run.

/// What is written, what runs, and why. All that apply are applied, from the top. `{topic}` is a prefix, `{port}`
/// and `{other_port}` are ports that nobody else uses.
pub const CHEAPER: &[(&str, &str, &str)] = &[
    ("cargo run --release --", "eddy", "it is built"),
    (
        "simulate --preset kinds",
        "simulate --preset kinds --particles 250 --duration 0.8",
        "small scenes",
    ),
    ("--scenes 400", "--scenes 5", "one of each kind"),
    ("--scenes 96", "--scenes 5", "one of each kind"),
    ("--scenes 10 ", "--scenes 5 ", "one of each kind"),
    ("--scenes 20", "--scenes 5", "one of each kind"),
    ("eddy train --data", "eddy train --config quick.toml --data", "a few windows an epoch"),
    ("--epochs 40", "--epochs 1", "one epoch"),
    ("--epochs 12", "--epochs 1", "one epoch"),
    ("--starts 2", "--starts 1", "one rollout a scene"),
    ("eddy eval", "eddy eval --horizon 20", "the scenes are short"),
    (
        "eddy eval --horizon 20 --compare",
        "eddy eval --compare",
        "it has the horizon of its reports",
    ),
    (
        "checkpoints/elsewhere",
        "checkpoints/particle-mingru",
        "no PyTorch here; the shipped checkpoint stands in",
    ),
    ("10.0.0.1:7447", "127.0.0.1:{port}", "nobody is there"),
    ("--preset snowball --publish", "--preset snowball --duration 0.5 --publish", "a short scene"),
    ("eddy demo", "eddy demo --headless --seconds 1", "a short scene"),
    ("--seconds 1 --headless --seconds 4", "--seconds 1", "a short scene"),
    ("eddy replay bags/sample --rate 0.2", "eddy replay bags/sample", "at its own pace"),
    (
        "--particles 2500,10000 --threads 1,2",
        "--particles 1000 --threads 1 --seconds 0.02",
        "one case",
    ),
    (
        "bench inference",
        "bench inference --device flex --particles 100 --seconds 0.02 --threads 1",
        "a short look on one device",
    ),
    ("bench training", "bench training --seconds 0.02", "a short look"),
    ("bench transport", "bench transport --messages 20", "a short look"),
    ("bench node", "bench node --seconds 0.5", "a short look"),
    ("--hertz 250 --seconds 15", "--hertz 250 --seconds 0.5", "a short look"),
    ("bench bag --seconds 4", "bench bag --seconds 0.1 --particles 1000", "a short look"),
    (
        "bench view --particles 100000 --seconds 4",
        "bench view --particles 250 --seconds 0.2",
        "a short look",
    ),
    ("--view 8081", "--view {port}", "ports that nobody else has"),
    ("--foxglove", "--foxglove 0", "any port that is free"),
    ("--view 8082", "--view {other_port}", "the same"),
    ("eddy study", "eddy study --config study.toml", "few steps of small networks"),
    ("--duration 10", "--duration 1", "a short look"),
    ("--wait 5", "--wait 0.2", "nobody else is there"),
    ("--rivals mpm,chaos", "--rivals mpm,chaos --starts 1", "one rollout a scene"),
    (
        "--to shm",
        "--to shm --remap /particles:=/{topic}/particles",
        "shared memory is that of the whole machine",
    ),
    ("shm:/", "shm:/{topic}/", "the same"),
    ("/particles:=/truth", "/particles:=/{topic}/truth", "the same"),
    ("10.0.0.1:7450", "127.0.0.1:{port}", "one machine plays both"),
    ("10.0.0.2:7450", "127.0.0.1:{other_port}", "one machine plays both"),
];

/// Commands that do not run here, and why.
pub const NOT_HERE: &[(&str, &str)] = &[
    ("cargo test --release", "it is what runs this"),
    ("cargo install --locked --path .", "it builds what is built"),
    ("ros2 topic hz /prediction", "a ROS 2; tests/peers/run talks to one"),
    ("ros2 param set /eddy_node horizon 20", "a ROS 2; tests/peers/run talks to one"),
    (
        r#"ros2 service call /eddy_replay/seek rosbag2_interfaces/srv/Seek "{time: {sec: 12, nanosec: 500000000}}""#,
        "a ROS 2; tests/peers/sdk_peer.py calls the service",
    ),
    (
        "tensorboard --logdir checkpoints/frame",
        "TensorBoard; tests/peers/check_training.py reads the files with it",
    ),
    (
        "PYTHONPATH=tests/peers python3 train.py",
        "PyTorch; tests/peers/torch_exchange.py takes networks both ways",
    ),
    (
        "python3 tests/peers/taichi_solver.py target/release/eddy",
        "hours of an idle machine, Taichi and PyTorch",
    ),
    (
        "python3 tests/peers/torch_speed.py target/release/eddy",
        "hours of an idle machine, Taichi and PyTorch",
    ),
    ("tests/bench/steady.sh", "hours of an idle machine, Taichi and PyTorch"),
    (
        r#"openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 365 -subj "/CN=eddy" -keyout ca_key.pem -out ca.pem"#,
        "certificates; tests/all/secure.rs makes such with rcgen",
    ),
    (
        r#"openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=robot" -keyout key.pem -out request.pem"#,
        "certificates; tests/all/secure.rs makes such with rcgen",
    ),
    (
        r#"printf "subjectAltName=IP:127.0.0.1,DNS:robot.local" > names"#,
        "certificates; tests/all/secure.rs makes such with rcgen",
    ),
    (
        "openssl x509 -req -in request.pem -CA ca.pem -CAkey ca_key.pem -days 365 -extfile names -out certificate.pem",
        "certificates; tests/all/secure.rs makes such with rcgen",
    ),
    (
        "ZENOH_SESSION_CONFIG_URI=/etc/eddy/recorder.json5 eddy record zenoh:/particles --output bags/live",
        "files in /etc; tests/all/secure.rs runs both with the example",
    ),
    (
        "ZENOH_SESSION_CONFIG_URI=/etc/eddy/player.json5 eddy replay bags/sample --to zenoh --wait-for 1",
        "files in /etc; tests/all/secure.rs runs both with the example",
    ),
    ("install -D target/release/eddy /usr/local/bin/eddy", "systemd, root or Docker"),
    ("useradd --system --create-home --home-dir /var/lib/eddy eddy", "systemd, root or Docker"),
    (
        "install -D -m 644 launch_configs/node_lookahead.toml /etc/eddy/node.toml",
        "systemd, root or Docker",
    ),
    (
        "install -m 644 docs/src/deploy/eddy-node.service /etc/systemd/system/",
        "systemd, root or Docker",
    ),
    ("systemctl daemon-reload && systemctl enable --now eddy-node", "systemd, root or Docker"),
    ("journalctl -u eddy-node -f", "systemd, root or Docker"),
    ("docker build -f docs/src/deploy/Dockerfile -t eddy .", "systemd, root or Docker"),
    (
        "docker run --rm --network host --ipc host --pid host -v /tmp/iceoryx2:/tmp/iceoryx2 eddy node --input shm:/particles --output shm:/prediction",
        "systemd, root or Docker",
    ),
    (
        "docker run --rm --network host eddy node --input zenoh:/particles --output zenoh:/prediction",
        "systemd, root or Docker",
    ),
];
