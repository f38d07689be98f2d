//! The files that a package ships beside the programs: manual pages, completions, and those of `sinew-node`.

use std::{collections::BTreeSet, path::Path, process::Command};

use serde_json::Value;
use sinew_testkit::{TestDirectory, program};

use crate::scenario::{Answer, sinew};

/// Fewer commands than that are a fault of this test.
const COMMANDS_MIN: usize = 20;

/// Returns the commands that the help lists.
fn commands(help: &str) -> BTreeSet<String> {
    let lines = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    let lines = lines.take_while(|line| line.starts_with("  "));
    let names =
        lines.filter(|line| !line.starts_with("   ")).filter_map(|line| line.split_whitespace().next());
    names.filter(|name| *name != "help").map(str::to_owned).collect()
}

/// Returns all commands of `sinew`.
fn all() -> BTreeSet<String> {
    let all = commands(&sinew(&["--help"], Path::new("/")).out);
    assert!(all.len() >= COMMANDS_MIN, "{all:?}");
    all
}

/// Returns a file of the project.
fn read(file: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(file);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn completions_of_every_shell_have_the_commands() {
    for shell in ["bash", "zsh", "fish"] {
        let answer = sinew(&["completions", shell], Path::new("/"));
        assert_eq!(answer.code, Some(0), "{shell}: {}", answer.err);
        let words: BTreeSet<_> =
            answer.out.split(|letter: char| !letter.is_alphanumeric() && letter != '-').collect();
        for name in all() {
            assert!(words.contains(name.as_str()), "{shell} does not complete {name}");
        }
    }
}

#[test]
fn every_command_has_a_manual_page() {
    let directory = TestDirectory::new();
    let folder = directory.join("");
    let folder = folder.to_str().expect("a short path");
    let answer = sinew(&["man", folder, "--json"], Path::new("/"));
    assert_eq!(answer.code, Some(0), "{}", answer.err);
    let json = answer.json();
    let listed: BTreeSet<_> =
        json["pages"].as_array().expect("a list").iter().filter_map(|name| name.as_str()).collect();
    let names = std::fs::read_dir(folder).expect("the test's own directory");
    let written: BTreeSet<_> =
        names.map(|entry| entry.expect("it is readable").file_name().display().to_string()).collect();
    assert_eq!(written, listed.iter().map(ToString::to_string).collect::<BTreeSet<_>>());
    for name in all() {
        let file = format!("sinew-{name}.1");
        let page = std::fs::read_to_string(directory.join(&file)).expect("each command has a page");
        assert!(page.contains(&format!(".TH sinew-{name} 1 ")), "{page}");
        for section in ["NAME", "SYNOPSIS", "DESCRIPTION", "OPTIONS"] {
            assert!(page.contains(&format!("\n.SH {section}\n")), "{file} has no {section}");
        }
    }
    // Also of commands below commands, and not of those that are hidden.
    assert!(listed.contains("sinew-keys-init.1") && !listed.contains("sinew-host.1"), "{listed:?}");
    let page = std::fs::read_to_string(directory.join("sinew.1")).expect("the program has a page");
    assert!(page.contains(".SH \"EXIT CODES\"") && page.contains(".SH EXAMPLES"), "{page}");
}

#[test]
fn man_needs_an_existing_folder() {
    let answer = sinew(&["man", "/nowhere/at/all"], Path::new("/"));
    assert_eq!(answer.code, Some(1), "{}", answer.out);
    assert!(
        answer.err.contains("/nowhere/at/all/sinew") && answer.err.contains("existing folder"),
        "{}",
        answer.err
    );
}

#[test]
fn files_of_the_node_have_its_options() {
    let help = Answer::of(Command::new(program("sinew-node")).arg("--help")).out;
    let words = help.split(|letter: char| !letter.is_alphanumeric() && letter != '-');
    let options: BTreeSet<_> = words.filter_map(|word| word.strip_prefix("--")).collect();
    assert!(options.contains("help"), "{help}");
    let page = read("packages/node/sinew-node.1").replace('\\', "");
    for file in ["completion.bash", "completion.zsh", "completion.fish"] {
        let text = read(&format!("packages/node/{file}"));
        for option in &options {
            assert!(text.contains(option), "{file} does not complete --{option}");
        }
    }
    for option in &options {
        assert!(page.contains(&format!("--{option}")), "the manual page lacks --{option}");
    }
    let codes = help.lines().skip_while(|line| *line != "Exit codes:").skip(1);
    let codes: Vec<_> = codes.take_while(|line| !line.is_empty()).collect();
    assert!(codes.len() >= 3, "{help}");
    for line in codes {
        let (code, meaning) = line.trim().split_once("  ").expect("a code, and its meaning");
        assert!(page.contains(&format!(".B {code}\n{meaning}\n")), "the manual page lacks {line}");
    }
}

#[test]
fn unit_of_the_package_is_that_of_the_book() {
    let unit = read("packages/debian/sinew-node@.service");
    let page = read("docs/book/src/how-to/systemd.md");
    let (_, rest) = page.split_once("```ini\n").expect("the page has a unit");
    let (shown, _) = rest.split_once("```").expect("the unit ends");
    let own = ["Description=", "ExecStart=", "StateDirectory="];
    let settings = |text: &str| -> BTreeSet<String> {
        let lines = text.lines().filter(|line| line.contains('=') && !line.starts_with('#'));
        lines.filter(|line| !own.iter().any(|key| line.starts_with(key))).map(str::to_owned).collect()
    };
    let (unit, shown) = (settings(&unit), settings(shown));
    assert!(shown.contains("Type=notify"), "{shown:?}");
    let missing: Vec<_> = shown.difference(&unit).collect();
    assert!(missing.is_empty(), "packages/debian/sinew-node@.service has not: {missing:?}");
}

#[test]
fn options_of_containers_are_explained() {
    let container: Value =
        serde_json::from_str(&read(".devcontainer/devcontainer.json")).expect("it is JSON without comments");
    let page = read("docs/book/src/how-to/containers.md");
    let options = container["runArgs"].as_array().expect("a list of options");
    assert!(options.iter().any(|option| option == "--ulimit=rtprio=99"), "{options:?}");
    for option in options {
        let option = option.as_str().expect("an option is a text");
        let apart = option.replacen('=', " ", 1);
        assert!(page.contains(option) || page.contains(&apart), "the page does not explain {option}");
    }
}

#[test]
fn development_container_has_the_tools_of_checks() {
    let run = read(".ci/run");
    let (_, rest) = run.split_once("tools=(\n").expect("it has a list of tools");
    let (tools, _) = rest.split_once("\n)").expect("the list ends");
    let packages: BTreeSet<_> = tools
        .lines()
        .map(|line| line.split_whitespace().nth(1).expect("a command, and its package"))
        .collect();
    assert!(packages.contains("valgrind"), "{packages:?}");
    let prepare = read("packages/prepare");
    let (_, develop) = prepare.split_once("\ndevelop)\n").expect("it has a part for developers");
    let installed: BTreeSet<_> = develop.split_whitespace().collect();
    let missing: Vec<_> = packages.difference(&installed).collect();
    assert!(missing.is_empty(), "packages/prepare develop does not install {missing:?}");
    for file in ["Dockerfile", "packages/check"] {
        assert!(read(file).contains("packages/prepare"), "{file} has a preparation of its own");
    }
}
