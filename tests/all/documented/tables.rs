//! Commands that run with changes, and commands that do not run.

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

/// Commands that do not run here, and the reason.
pub const NOT_HERE: &[(&str, &str)] = &[
    ("cargo test --release", "it runs this test"),
    ("cargo install --locked --path .", "already built"),
    ("cargo build --release -p eddy-cuda-emulator --examples", "recompiles dependencies"),
    (
        "tests/gpu/run target/release/examples/{frame_training,frame_inference,particle_training,particle_inference,solver}",
        "needs an NVIDIA GPU and PyTorch",
    ),
    (
        "eddy simulate --preset kinds --scenes 400 --device cuda --output bags/gpu",
        "needs an NVIDIA GPU",
    ),
    (
        "cargo build --release --features object-store",
        "recompiles dependencies; tests/peers/store_peer.py runs such commands with servers of stores",
    ),
    (
        "eddy simulate --preset kinds --scenes 60 --seed 1 --output s3://my-bucket/kinds",
        "needs a store; tests/peers/store_peer.py",
    ),
    (
        "eddy train --data s3://my-bucket/kinds --output checkpoints/mine",
        "needs a store; tests/peers/store_peer.py",
    ),
    (
        "eddy eval --checkpoint checkpoints/mine --data gs://another-bucket/unseen --output reports/unseen",
        "needs a store; tests/peers/store_peer.py",
    ),
    (
        "eddy replay s3://my-bucket/kinds/scene_0000 --to zenoh",
        "needs a store; tests/peers/store_peer.py",
    ),
    (
        "eddy eval --checkpoint checkpoints/particle-mingru --data bags/unseen --predictions mine=bags/mine --output reports/both",
        "needs another program; tests/peers/predictions_peer.py",
    ),
    (
        "python3 tests/peers/rivals/rival.py train neural_mpm neural_mpm.pt --data arrays --minutes 20",
        "needs PyTorch",
    ),
    (
        "python3 tests/peers/rivals/rival.py predict neural_mpm neural_mpm.pt --eddy target/release/eddy --data bags/unseen --output bags/neural_mpm",
        "needs PyTorch",
    ),
    (
        "python3 tests/peers/rivals/rival.py time neural_mpm neural_mpm.pt --data arrays",
        "needs PyTorch",
    ),
    (
        "eddy eval --checkpoint checkpoints/particle-mingru --data bags/unseen --predictions neural_mpm=bags/neural_mpm --output reports/rivals",
        "needs PyTorch",
    ),
    ("ros2 topic hz /prediction", "needs ROS 2; tests/peers/run tests it"),
    ("ros2 param set /eddy_node horizon 20", "needs ROS 2; tests/peers/run tests it"),
    (
        r#"ros2 service call /eddy_replay/seek rosbag2_interfaces/srv/Seek "{time: {sec: 12, nanosec: 500000000}}""#,
        "needs ROS 2; tests/peers/sdk_peer.py calls the service",
    ),
    (
        "tensorboard --logdir checkpoints/frame",
        "needs TensorBoard; tests/peers/check_training.py uses it",
    ),
    (
        "PYTHONPATH=tests/peers python3 train.py",
        "needs PyTorch; tests/peers/torch_exchange.py tests both directions",
    ),
    (
        "python3 tests/peers/taichi_solver.py target/release/eddy-lab",
        "needs hours on an idle machine, Taichi and PyTorch",
    ),
    (
        "python3 tests/peers/torch_speed.py target/release/eddy-lab",
        "needs hours on an idle machine, Taichi and PyTorch",
    ),
    ("tests/bench/latency.sh", "needs forty minutes, an idle machine and real-time rights"),
    ("tests/bench/steady.sh", "needs hours on an idle machine, Taichi and PyTorch"),
    (
        r#"openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 365 -subj "/CN=eddy" -keyout ca_key.pem -out ca.pem"#,
        "creates certificates; tests/all/secure.rs does so with rcgen",
    ),
    (
        r#"openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=robot" -keyout key.pem -out request.pem"#,
        "creates certificates; tests/all/secure.rs does so with rcgen",
    ),
    (
        r#"printf "subjectAltName=IP:127.0.0.1,DNS:robot.local" > names"#,
        "creates certificates; tests/all/secure.rs does so with rcgen",
    ),
    (
        "openssl x509 -req -in request.pem -CA ca.pem -CAkey ca_key.pem -days 365 -extfile names -out certificate.pem",
        "creates certificates; tests/all/secure.rs does so with rcgen",
    ),
    (
        "ZENOH_SESSION_CONFIG_URI=/etc/eddy/recorder.json5 eddy record zenoh:/particles --output bags/live",
        "needs files in /etc; tests/all/secure.rs runs both with the example",
    ),
    (
        "ZENOH_SESSION_CONFIG_URI=/etc/eddy/player.json5 eddy replay bags/sample --to zenoh --wait-for 1",
        "needs files in /etc; tests/all/secure.rs runs both with the example",
    ),
    ("python/build.sh", "builds the program again, for a wheel"),
    ("pip install python/dist/eddy_surrogates-*.whl", "builds the program again, for a wheel"),
    (
        "python/reference.sh python/dist/eddy_surrogates-*.whl",
        "builds the program again, for a wheel",
    ),
    ("pip install torch==2.15.0", "needs PyTorch; python/examples/check runs it"),
    ("python python/examples/torch_tensors.py", "needs PyTorch; python/examples/check runs it"),
    ("pip install taichi==1.7.4", "needs Taichi and a quarter of an hour"),
    (
        "python python/examples/mpm_taichi.py --output out/taichi",
        "needs Taichi and a quarter of an hour",
    ),
    (
        "docs/src/deploy/debian.sh target/release/eddy target/debian",
        "tests/packages/check_deb installs what it makes",
    ),
    (
        "apt install ./target/debian/eddy_0.1.0_amd64.deb",
        "tests/packages/check_deb installs what it makes",
    ),
    (
        "docs/src/deploy/container.sh target/debian/eddy_0.1.0_amd64.deb target/container",
        "needs root; tests/packages/check_container runs what it makes",
    ),
    ("podman load --input target/container/eddy.oci.tar", "needs systemd, root or Docker"),
    ("docs/src/deploy/sbom.sh target/sbom", "installs a tool of cargo's"),
    ("cargo deny check bans licenses sources", "needs cargo-deny; .ci/run runs it"),
    (
        "colcon build --cmake-args -DEDDY=/usr/bin/eddy",
        "needs ROS 2; tests/packages/check_ament builds the packages",
    ),
    (
        "ros2 run eddy_ros eddy node --input dds:/particles --output dds:/prediction",
        "needs ROS 2; tests/packages/check_ament runs the program",
    ),
    (
        "ros2 launch eddy_ros node.launch.yaml input:=dds:/truth output:=dds:/ahead horizon:=20 namespace:=/robot1",
        "needs ROS 2; tests/packages/check_ament runs what the file says",
    ),
    (
        "ros2 launch eddy_ros replay.launch.yaml bag:=/usr/share/eddy/bags/sample",
        "needs ROS 2; tests/packages/check_ament runs what the file says",
    ),
    ("systemctl enable --now eddy-node", "needs systemd, root or Docker"),
    ("install -D target/release/eddy /usr/local/bin/eddy", "needs systemd, root or Docker"),
    (
        "useradd --system --create-home --home-dir /var/lib/eddy eddy",
        "needs systemd, root or Docker",
    ),
    (
        "install -D -m 644 launch_configs/node/lookahead.toml /etc/eddy/node.toml",
        "needs systemd, root or Docker",
    ),
    (
        "install -m 644 docs/src/deploy/eddy-node.service /etc/systemd/system/",
        "needs systemd, root or Docker",
    ),
    (
        "systemctl daemon-reload && systemctl enable --now eddy-node",
        "needs systemd, root or Docker",
    ),
    ("journalctl -u eddy-node -f", "needs systemd, root or Docker"),
    ("docker build -f docs/src/deploy/Dockerfile -t eddy .", "needs systemd, root or Docker"),
    (
        "docker run --rm --network host --ipc host --pid host -v /tmp/iceoryx2:/tmp/iceoryx2 eddy node --input shm:/particles --output shm:/prediction",
        "needs systemd, root or Docker",
    ),
    (
        "docker run --rm --network host eddy node --input zenoh:/particles --output zenoh:/prediction",
        "needs systemd, root or Docker",
    ),
];
