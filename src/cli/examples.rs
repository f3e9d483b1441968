//! The examples at the end of `--help`; a test runs all of them.

use eddy_cli::arguments::Examples;

/// The examples of each command.
pub(super) const EXAMPLES: &[Examples] = &[
    ("demo", &["eddy demo", "eddy demo --headless --seconds 4 --output bags/short"]),
    (
        "simulate",
        &[
            "eddy simulate --preset kinds --scenes 20 --seed 1 --output bags/mm",
            "eddy simulate --preset kinds --scenes 96 --seed 2001 --output bags/calibration",
            "eddy simulate --scene launch_configs/scenes/dam_break.toml --output bags/dam",
            "eddy simulate --preset snowball --publish zenoh:/particles",
            "eddy simulate --preset kinds --scenes 400 --device cuda --output bags/gpu",
        ],
    ),
    (
        "record",
        &[
            "eddy record zenoh:/particles zenoh:/prediction --output bags/live",
            "eddy record --all --exclude /cloud --output bags/all",
            "eddy record zenoh:/particles --output bags/stiff --custom-data eddy_stiffness=1e5",
        ],
    ),
    (
        "replay",
        &[
            "eddy replay bags/sample",
            "eddy replay bags/sample --to shm --rate 0.5",
            "eddy replay bags/sample --remap /particles:=/truth",
            "eddy replay bags/sample --loop --clock",
        ],
    ),
    (
        "train",
        &[
            "eddy train --data bags/mm --output checkpoints/mine --epochs 1",
            "eddy train --data bags/mm --output checkpoints/lstm --core lstm --epochs 1 --seed 1 2",
        ],
    ),
    ("devices", &["eddy devices"]),
    (
        "node",
        &[
            "eddy node",
            "eddy node --input shm:/particles --output shm:/prediction --horizon 10 --publish all",
            "eddy node --checkpoint checkpoints/mine --ros-args -r __ns:=/robot1 -p max_gap:=5",
            "eddy node --horizon 20 --ros-args -p max_expected_error:=0.05",
            "eddy node --stiffness 1e4",
        ],
    ),
    (
        "tools",
        &[
            "eddy tools launch_configs/tools/robot.toml",
            "eddy tools launch_configs/tools/robot.toml --input dds:/particles --wait 0.05",
        ],
    ),
    (
        "predict",
        &[
            "eddy predict --input bags/sample --output bags/predicted",
            "eddy predict --checkpoint checkpoints/mine --input bags/sample --output bags/ahead --horizon 10",
        ],
    ),
    ("calibrate", &["eddy calibrate --checkpoint checkpoints/mine --data bags/calibration"]),
    (
        "eval",
        &[
            "eddy eval --checkpoint checkpoints/mine --data bags/mm --output reports/mine",
            "eddy eval --checkpoint checkpoints/particle-mingru checkpoints/mine --data bags/mm --output reports/both --references mpm,chaos",
            "eddy eval --checkpoint checkpoints/particle-mingru --data bags/mm --output reports/without_area --without-rules area",
        ],
    ),
    ("launch", &["eddy launch launch_configs/launch/replay_node_record.toml"]),
    ("bag info", &["eddy bag info bags/sample"]),
    ("bag check", &["eddy bag check bags/sample"]),
    ("bag recover", &["eddy bag recover bags/sample/scene_0000_0.mcap --output bags/recovered"]),
    (
        "bag cut",
        &[
            "eddy bag cut bags/sample --start 0.2 --duration 0.5 --output bags/part",
            "eddy bag cut bags/sample --end 0.4 --output bags/beginning",
        ],
    ),
    ("bag merge", &["eddy bag merge bags/sample bags/predicted --output bags/beside"]),
    ("bag filter", &["eddy bag filter bags/beside --topics /prediction --output bags/only"]),
    ("bag cloud", &["eddy bag cloud bags/sample --output bags/cloud"]),
    ("bag reindex", &["eddy bag reindex bags/recovered"]),
    (
        "bag export",
        &[
            "eddy bag export bags/sample --format npz --output exported",
            "eddy bag export bags/mm --format gns --output exported_gns",
        ],
    ),
    ("bag import", &["eddy bag import exported --format npz --output bags/imported"]),
    (
        "bag render",
        &[
            "eddy bag render bags/sample --output sample.gif",
            "eddy bag render bags/beside --topic /particles /prediction --color speed --output speed.png",
        ],
    ),
    ("topic list", &["eddy topic list", "eddy topic list --from shm,zenoh,dds --wait 5"]),
    ("topic echo", &["eddy topic echo zenoh:/particles --count 1"]),
    ("topic hz", &["eddy topic hz zenoh:/prediction --duration 10"]),
    ("topic info", &["eddy topic info zenoh:/particles"]),
    ("service list", &["eddy service list --show-types"]),
    ("service type", &["eddy service type /eddy_node/reset"]),
    (
        "service call",
        &[
            "eddy service call /eddy_node/reset std_srvs/srv/Trigger",
            r#"eddy service call /eddy_node/get_parameters rcl_interfaces/srv/GetParameters '{"names":["horizon"]}'"#,
        ],
    ),
    ("param list", &["eddy param list /eddy_node", "eddy param list --from zenoh,dds --wait 5"]),
    ("param get", &["eddy param get /eddy_node horizon"]),
    ("param set", &["eddy param set /eddy_node horizon 10"]),
    ("param dump", &["eddy param dump /eddy_node"]),
    ("completions", &["source <(eddy completions bash)", "eddy completions zsh > _eddy"]),
    ("man", &["eddy man man1"]),
];
