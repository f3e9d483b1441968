//! Commands of the documents with options that make them short: small scenes, few windows, unused ports.

use Change::{IfGiven, Set, UnlessGiven};

/// A change to the options of a command. Each text is an option, and its value if it has one.
#[derive(Clone, Copy, Debug)]
enum Change {
    /// Replaces the option, or adds it.
    Set(&'static str),
    /// Replaces the option.
    IfGiven(&'static str),
    /// Adds the option.
    UnlessGiven(&'static str),
}

/// The words of a command, words that its line must hold, and what changes. All rows that match apply, in their order. `{port}`
/// and `{other_port}` are unused ports.
const SHORT: &[(&str, &str, &[Change])] = &[
    ("simulate", "--preset kinds", SMALL),
    ("simulate", "--output bags/calibration", &[Set("--scenes 10")]),
    ("simulate", "--publish", &[Set("--duration 0.5")]),
    ("plan simulate", "--preset kinds", SMALL),
    ("train", "--data", &[UnlessGiven("--config quick.toml"), IfGiven("--epochs 1")]),
    ("calibrate", "", &[Set("--horizon 20")]),
    ("eval", "--data", &[Set("--horizon 20"), Set("--starts 1")]),
    ("demo", "", &[Set("--headless"), Set("--seconds 1")]),
    ("replay", "--rate 0.2", &[Set("--rate 1")]),
    ("replay", "", &[IfGiven("--view {port}")]),
    ("node", "", &[IfGiven("--view {other_port}"), IfGiven("--foxglove 0")]),
    // The search for the topic counts.
    ("topic hz", "", &[IfGiven("--duration 8")]),
    ("topic list", "", &[IfGiven("--wait 0.2")]),
    ("param list", "", &[IfGiven("--wait 0.2")]),
    ("study", "", &[Set("--config study.toml")]),
    ("bench solver", "", &[Set("--particles 1000"), Set("--threads 1"), Set("--seconds 0.02")]),
    (
        "bench inference",
        "",
        &[Set("--device flex"), Set("--particles 100"), Set("--seconds 0.02"), Set("--threads 1")],
    ),
    ("bench training", "", &[Set("--seconds 0.02")]),
    ("bench transport", "", &[Set("--messages 20")]),
    ("bench node", "", &[Set("--seconds 0.5")]),
    (
        "bench group",
        "",
        &[
            Set("--nodes 2"),
            Set("--streams 10"),
            Set("--particles 50"),
            Set("--hertz 10"),
            Set("--seconds 1"),
        ],
    ),
    ("bench replay", "", &[Set("--seconds 0.5")]),
    ("bench bag", "", &[Set("--seconds 0.1"), Set("--particles 1000")]),
    ("bench view", "", &[Set("--seconds 0.2"), Set("--particles 250")]),
];

/// One small scene of each kind.
const SMALL: &[Change] = &[Set("--particles 250"), Set("--duration 0.8"), IfGiven("--scenes 5")];

/// Other machines are this one. A client of Zenoh does not start without its router, a peer does.
const MACHINES: &[(&str, &str)] = &[
    ("10.0.0.1:7447", "127.0.0.1:{port}"),
    (r#"mode="client";"#, ""),
    ("10.0.0.1:7450", "127.0.0.1:{port}"),
    ("10.0.0.2:7450", "127.0.0.1:{other_port}"),
];

/// How documents start the programs without an installation.
const PROGRAMS: &[(&str, &str)] =
    &[("cargo run --release -p eddy-lab -- ", "eddy-lab "), ("cargo run --release -- ", "eddy ")];

/// A short form of a command.
pub fn short(line: &str) -> String {
    let replace = |line: String, (from, to): &(&str, &str)| line.replace(from, to);
    let line = PROGRAMS.iter().chain(MACHINES).fold(line.to_owned(), replace);
    let mut words: Vec<&str> = line.split(' ').collect();
    let Some(program) = words.iter().position(|word| ["eddy", "eddy-lab"].contains(word)) else {
        return line;
    };
    let command = words.split_off(program + 1);
    let mut command: Vec<String> = command.into_iter().map(str::to_owned).collect();
    for (name, held, changes) in SHORT {
        let all = command.join(" ");
        if all.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with(' '))
            && all.contains(held)
        {
            let place = name.split(' ').count();
            changes.iter().for_each(|change| apply(&mut command, place, *change));
        }
    }
    let words = words.into_iter().map(str::to_owned).chain(command);
    words.collect::<Vec<_>>().join(" ")
}

/// Changes the options of a command; new ones stand before word `place`.
fn apply(command: &mut Vec<String>, place: usize, change: Change) {
    let (Set(option) | IfGiven(option) | UnlessGiven(option)) = change;
    let (name, value) =
        option.split_once(' ').map_or((option, None), |(name, value)| (name, Some(value)));
    let given = command.iter().position(|word| word == name);
    match (change, given) {
        (IfGiven(_), None) | (UnlessGiven(_), Some(_)) => return,
        (_, Some(at)) => {
            let has_value = command.get(at + 1).is_some_and(|word| !word.starts_with('-'));
            command.drain(at..=at + usize::from(value.is_some() && has_value));
        }
        (_, None) => {}
    }
    let words = [Some(name), value].into_iter().flatten().map(str::to_owned);
    command.splice(place..place, words);
}

#[test]
fn a_command_is_made_short() {
    for (line, expected) in [
        (
            "cargo run --release -- simulate --preset kinds --scenes 96 --seed 2 --output bags/a",
            "eddy simulate --scenes 5 --duration 0.8 --particles 250 --preset kinds --seed 2 --output bags/a",
        ),
        (
            "A='b c' eddy node --foxglove --input shm:/a",
            "A='b c' eddy node --foxglove 0 --input shm:/a",
        ),
        ("eddy train --config a.toml --data b", "eddy train --config a.toml --data b"),
        ("eddy train --data b --epochs 40", "eddy train --epochs 1 --config quick.toml --data b"),
        ("eddy demo --headless --seconds 4", "eddy demo --seconds 1 --headless"),
        ("cat simulate", "cat simulate"),
    ] {
        assert_eq!(short(line), expected);
    }
}
