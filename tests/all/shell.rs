//! What a shell and a reader of manuals are given, and what the program says of a name that is nearly right.

use std::{
    collections::BTreeSet,
    fs::{self, File},
    path::Path,
    process::Command,
};

use crate::support::{commands, eddy, fail, succeed};

/// What bash offers after `words`, whose last one is being typed.
fn completed(words: &[&str]) -> Vec<String> {
    let script = r#"
        source <("$EDDY" completions bash)
        COMP_WORDS=("$@") COMP_CWORD=$(($# - 1))
        _eddy eddy "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD - 1]}"
        printf '%s\n' "${COMPREPLY[@]}"
    "#;
    let mut bash = Command::new("bash");
    bash.args(["-euc", script, "bash"]).args(words).env("EDDY", env!("CARGO_BIN_EXE_eddy"));
    let output = bash.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect()
}

#[test]
fn bash_completes_commands_options_and_values() {
    assert_eq!(completed(&["eddy", "sim"]), ["simulate"]);
    assert_eq!(completed(&["eddy", "bag", "rei"]), ["reindex"]);
    assert_eq!(completed(&["eddy", "node", "--hor"]), ["--horizon"]);
    assert_eq!(completed(&["eddy", "train", "--core", "min"]), ["minlstm", "mingru"]);
    assert_eq!(completed(&["eddy", "simulate", "--preset", "snow"]), ["snowball"]);
}

#[test]
fn what_has_moved_to_the_laboratory_is_said_and_offered_nowhere() {
    for (typed, word) in [
        ("bench solver --threads 2", "bench"),
        ("--log-level error study cores --output reports/study", "study"),
        ("plan list plan.json --arrays", "plan"),
        ("help plan", "plan"),
    ] {
        let said = fail(2, typed.split(' '));
        let expected =
            format!("{word} is a command of the program eddy-lab: `eddy-lab {word} ...`");
        assert_eq!(said, format!("eddy: {expected}\n"), "{typed}");
    }
    for offered in [succeed(["--help"]), succeed(["completions", "bash"])] {
        assert!(!offered.contains("bench") && !offered.contains("study"), "{offered}");
    }
}

#[test]
fn every_shell_has_a_script_that_knows_every_command() {
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = succeed(["completions", shell]);
        for command in commands() {
            let name = command.last().map_or("eddy", String::as_str);
            assert!(script.contains(name), "{shell} does not know {name}");
        }
    }
}

#[test]
fn a_script_that_cannot_be_printed_is_an_error() {
    let full = File::options().write(true).open("/dev/full").unwrap();
    let output = eddy().args(["completions", "bash"]).stdout(full).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("cannot print the script: No space left"), "{said}");
}

#[test]
fn every_command_has_a_manual_page_with_its_options_and_examples() {
    let folder = tempfile::tempdir().unwrap();
    succeed(["man".as_ref(), folder.path().as_os_str()]);
    let mut pages = BTreeSet::new();
    for command in commands() {
        let name = [&["eddy".to_owned()], command.as_slice()].concat().join("-");
        let page = fs::read_to_string(folder.path().join(format!("{name}.1"))).unwrap();
        assert!(page.contains(&format!(".TH {name} 1 ")), "{name}: no title");
        for section in ["NAME", "SYNOPSIS", "DESCRIPTION", "OPTIONS"] {
            assert!(page.contains(&format!(".SH {section}")), "{name}: no {section}");
        }
        pages.insert(format!("{name}.1"));
    }
    let written = fs::read_dir(folder.path()).unwrap();
    let written: BTreeSet<_> =
        written.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    assert_eq!(written, pages);
    let page = fs::read_to_string(folder.path().join("eddy-node.1")).unwrap();
    assert!(page.contains(r"\-\-free\-run") && page.contains("Examples:"), "{page}");
}

/// What is typed, the exit code, and how the error ends.
const NEARLY: &[(&str, i32, &str)] = &[
    ("simulat", 2, "tip: a similar subcommand exists: 'simulate'"),
    ("node --horizn 3", 2, "tip: a similar argument exists: '--horizon'"),
    ("simulate --preset kindz --output o", 2, "tip: a similar value exists: 'kinds'"),
    ("train --data d --output o --core mingrru", 2, "tip: a similar value exists: 'mingru'"),
    ("node --input zneoh:/particles", 2, "; did you mean zenoh?"),
    ("record zenoh:particles --output /x", 2, "; did you mean /particles?"),
    ("replay bags/sample --to znoh", 2, "; did you mean zenoh?"),
    ("node --ros-args -p horizn:=3", 1, "group; did you mean horizon?"),
    ("replay bags/sample --topics /partcles", 1, "; did you mean /particles?"),
    ("bag filter bags/sample --topics /partcles --output o", 1, "; did you mean /particles?"),
    ("bag render bags/sample --topic /partcles --output o.gif", 1, "; did you mean /particles?"),
    ("bag import i --format npz --output o --material liqiud", 2, "; did you mean liquid?"),
    ("bag info bags/sampel", 1, "; did you mean bags/sample?"),
    ("train --data bag/sample --output o", 1, "; did you mean bags?"),
    (
        "predict --checkpoint checkpoints/particle-mingr --input bags/sample --output o",
        1,
        "; did you mean checkpoints/particle-mingru?",
    ),
    (
        "predict --checkpoint checkpoints/particle-mingru-stiff --input bags/sample --output o",
        1,
        "leave `--checkpoint` out, and give or state the stiffness",
    ),
    (
        "launch launch_configs/launch/chain_shn.toml",
        1,
        "; did you mean launch_configs/launch/chain_shm.toml?",
    ),
    ("simulate --scene nearly_scene.toml --output o", 1, "; did you mean solver.gravity?"),
    ("node --config nearly.toml", 1, "; did you mean horizon?"),
    (
        "train --data bags/sample --output o --config nearly_train.toml",
        1,
        "; did you mean minlstm?",
    ),
];

#[test]
fn errors_suggest_the_near_miss() {
    let folder = tempfile::tempdir().unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for name in ["bags", "checkpoints", "launch_configs"] {
        std::os::unix::fs::symlink(root.join(name), folder.path().join(name)).unwrap();
    }
    fs::write(folder.path().join("nearly.toml"), "[node]\nhorizn = 3\n").unwrap();
    fs::write(folder.path().join("nearly_scene.toml"), "gravity = 1.6\n").unwrap();
    fs::write(folder.path().join("nearly_train.toml"), "core = \"minlstn\"\n").unwrap();
    for (typed, code, said) in NEARLY {
        let output = eddy().args(typed.split(' ')).current_dir(folder.path()).output().unwrap();
        let errors = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(*code), "{typed}: {errors}");
        assert!(errors.contains(said), "{typed}: {errors}");
    }
}

#[test]
fn what_is_far_from_everything_gets_no_suggestion() {
    assert!(!fail(2, ["node", "--input", "tcp:/particles"]).contains("did you mean"));
    let unknown = fail(2, ["bag", "info", "bag", "--latest"]);
    assert!(unknown.contains("unexpected argument '--latest'"), "{unknown}");
    assert!(!unknown.contains("to pass '--latest' as a value"), "{unknown}");
}

/// Options that were renamed: a command with the old name and an invalid value, and the new name in its error.
const RENAMED: &[(&str, &str)] = &[("eval --rivals nobody", "--references <NAME>")];

#[test]
fn old_names_of_options_still_work() {
    for (typed, name) in RENAMED {
        let message = fail(2, typed.split(' '));
        assert!(message.contains("invalid value") && message.contains(name), "{typed}: {message}");
    }
}
