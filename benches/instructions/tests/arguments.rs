//! The command line of the program.

use std::process::Command;

#[test]
fn unknown_path_is_refused_with_the_known_ones() {
    let output = Command::new(env!("CARGO_BIN_EXE_instructions")).arg("nowhere").output().expect("it runs");
    assert_eq!(output.status.code(), Some(2));
    let words = String::from_utf8_lossy(&output.stderr);
    for path in ["same_thread", "direct", "nodes_own_thread"] {
        assert!(words.contains(path), "{words}");
    }
}
