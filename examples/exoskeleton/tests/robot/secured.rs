//! The secured robot, by the README's own commands: keys for all nodes, and a robot that accepts only nodes
//! with keys.

use crate::{alone, end, folder, sinew, start};

const README: &str = include_str!("../../../../README.md");

/// The words after this command on a line of the README, without a shell comment.
fn words_behind(command: &str) -> Vec<&'static str> {
    let mut found = README.lines().filter_map(|line| line.trim().strip_prefix(command));
    let words = found.next().unwrap_or_else(|| panic!("the README has no line with `{command}`"));
    words.split_whitespace().take_while(|word| *word != "#").collect()
}

#[test]
fn robot_walks_only_with_the_keys_of_the_readme() {
    let _alone = alone();
    let folder = folder("secured");
    let init = words_behind("cargo run --release -p sinew-cli -- keys init ");
    let robot = words_behind("cargo run --release -p exoskeleton -- --keys ");
    let robot = [&["--strides", "8", "--no-record", "--keys"], &robot[..]].concat();

    // given: no keys yet
    let refused = end(start(&folder, &robot), "the robot is refused");
    let words = String::from_utf8_lossy(&refused.stderr);
    assert!(
        !matches!(refused.status.code(), Some(0 | 3)),
        "it walked without the keys that it was to have: {words}"
    );
    assert!(words.contains("there is no such directory") && words.contains("sinew keys init "), "{words}");

    // and: keys in another order, with swapped addresses of the nodes
    let others = ["keys", "init", "exoskeleton", "hip", "knee", "ankle", "central", "--out", "others"];
    assert!(sinew(&folder, &others).status.success(), "names alone make keys");
    let refused = end(start(&folder, &["--strides", "8", "--keys", "others"]), "the robot is refused");
    let words = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{words}");
    for part in ["central", "hip", "knee", "ankle"] {
        assert!(words.contains(&format!("{part} is to be node")), "{words}");
    }
    // The remedy is one command that works, and creates the same keys as the README's.
    let command = words.lines().find_map(|line| line.trim().strip_prefix("sinew ")).expect("a command");
    assert!(command.contains(&init.join(" ")) && command.ends_with("--out others-2"), "{command}");
    let made = sinew(&folder, &command.split_whitespace().collect::<Vec<_>>());
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    assert!(!folder.join("runs").exists(), "nothing was begun");

    // when
    let made = sinew(&folder, &[&["keys", "init"], &init[..]].concat());
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let output = end(start(&folder, &robot), "the walk ends");

    // then
    let stdout = String::from_utf8_lossy(&output.stdout);
    let failed = String::from_utf8_lossy(&output.stderr);
    assert!(stdout.contains("stride 8 of 8"), "{stdout}\n{failed}");
    // Whether limits hold depends on the machine; that it walked does not.
    assert!(matches!(output.status.code(), Some(0 | 3)), "{:?}\n{stdout}\n{failed}", output.status);
    std::fs::remove_dir_all(&folder).expect("the folder of this test");
}
