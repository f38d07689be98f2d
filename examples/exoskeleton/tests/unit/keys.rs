//! Tests of `src/robot/launch/keys.rs`.

use super::*;
use crate::robot::topology::for_this_host;

#[test]
fn missing_keys_error_has_one_command_that_creates_all() {
    let mut topology = for_this_host(1).unwrap();
    "walker".clone_into(&mut topology.project);
    let directory = std::env::temp_dir().join(format!("exoskeleton-no-keys-{}", std::process::id()));
    topology.keys = Some(directory.clone());
    let error = |given: &Path| check(&topology, given).unwrap_err().to_string();
    let command =
        "\n  sinew keys init walker central=127.0.0.1 hip=127.0.0.2 knee=127.0.0.3 ankle=127.0.0.4 --out ";
    // There is no directory.
    let words = error(&directory);
    assert!(words.contains(&format!("{command}{}\n", directory.display())), "{words}");
    assert!(words.contains("there is no such directory"), "{words}");
    // It has other contents: each node is named, and another directory.
    std::fs::create_dir_all(directory.join("nodes")).unwrap();
    let words = error(&directory.join(""));
    std::fs::remove_dir_all(&directory).unwrap();
    assert!(words.contains(&format!("{command}{}-2\n", directory.display())), "{words}");
    for part in Part::ALL {
        assert!(words.contains(&format!("\n  {part}: ")), "{words}");
    }
    // A text that the shell would split is quoted.
    "ada's walker".clone_into(&mut topology.project);
    let words = check(&topology, Path::new("/nowhere/my keys")).unwrap_err().to_string();
    assert!(words.contains(r"sinew keys init 'ada'\''s walker' central="), "{words}");
    assert!(words.contains(" --out '/nowhere/my keys'\n"), "{words}");
    assert!(words.ends_with("--keys '/nowhere/my keys'"), "{words}");
    // Without keys nothing is checked.
    topology.keys = None;
    assert!(check(&topology, &directory).is_ok());
}

#[test]
fn mixed_authorities_and_node_directory_are_reported() {
    const KNEE: Part = Part::Joint(exoskeleton_model::joint::Joint::Knee);
    // given: files that are alike except for those of one node
    let mut topology = for_this_host(1).unwrap();
    let directory = std::env::temp_dir().join(format!("exoskeleton-two-authorities-{}", std::process::id()));
    topology.keys = Some(directory.clone());
    for part in Part::ALL {
        let keys = topology.node_config(part).security.keys.expect("it was set");
        std::fs::create_dir_all(&keys).unwrap();
        let authority = if part == KNEE { "another" } else { "ours" };
        for (name, text) in [("ca.pem", authority), ("discovery.key", "of all"), ("node.pem", "its own")] {
            std::fs::write(keys.join(name), text).unwrap();
        }
    }
    // when, then: that node is named
    let strange = strangers(&topology);
    assert!(matches!(&strange[..], [one] if one.part == KNEE && one.text.contains("of another authority")));
    std::fs::write(directory.join("ca.pem"), "ours").unwrap();
    let words = check(&topology, &directory).unwrap_err().to_string();
    assert!(words.contains("sinew keys issue") && !words.contains("keys init"), "{words}");
    // and: a user that names the directory of a node is shown the directory of the project
    let words = check(&topology, &directory.join("nodes/hip")).unwrap_err().to_string();
    std::fs::remove_dir_all(&directory).unwrap();
    assert!(words.ends_with(&format!("--keys {}", quoted(&directory.display().to_string()))), "{words}");
    assert!(!words.contains("keys init"), "{words}");
}
