//! Robot files: their values, and their faults.

use super::*;

const LEG: &str = r#"
[robot]
name = "my-leg"
keys = "keys"

[host.hip]
ssh = "robot@10.0.0.2"
folder = "/var/lib/sinew"

[node.central]
program = "bin/central"
config = "central.toml"

[node.hip]
host = "hip"
installed = "/usr/bin/hip"
arguments = ["--fast"]
environment = { SINEW_LOG = "info" }
after = ["central"]
ready = ["hip.drive"]
realtime_priority_max = 95
cpus = [2, 3]
"#;

fn read(text: &str) -> Result<Robot, ConfigError> {
    Robot::from_toml(text, Path::new("/robot"))
}

/// Returns the faults of the file with one text replaced.
fn faults(from: &str, to: &str) -> String {
    assert!(LEG.contains(from), "{from}");
    read(&LEG.replacen(from, to, 1)).expect_err("the file has a fault").to_string()
}

#[test]
fn file_is_read_with_paths_and_defaults() {
    let robot = read(LEG).unwrap_or_else(|faults| panic!("{faults}"));
    assert_eq!(robot.keys.as_deref(), Some(Path::new("/robot/keys")));
    assert_eq!((robot.ready_within, robot.stop_within), (READY_WITHIN, STOP_WITHIN));
    assert_eq!(robot.hosts.keys().collect::<Vec<_>>(), ["here", "hip"]);
    let central = &robot.nodes["central"];
    assert_eq!(central.program, Program::Copied("/robot/bin/central".into()));
    assert_eq!((central.host.as_str(), central.has_keys, &central.arguments), (HERE, true, &None));
    let hip = &robot.nodes["hip"];
    assert_eq!(hip.program, Program::Installed("/usr/bin/hip".to_owned()));
    assert_eq!(
        (&hip.after[..], &hip.ready[..]),
        (&["central".to_owned()][..], &["hip.drive".to_owned()][..])
    );
    assert_eq!((hip.limits.realtime_priority_max, &hip.limits.cpus[..]), (95, &[2, 3][..]));
}

#[test]
fn misspelt_keys_and_names_have_nearest_ones() {
    let text = faults("after =", "afetr =");
    assert!(text.contains("node.hip.afetr (line") && text.contains("write after, the nearest one"), "{text}");
    let text = faults("[\"central\"]", "[\"centrl\"]");
    assert!(
        text.contains("found \"centrl\"") && text.contains("write \"central\", the nearest one"),
        "{text}"
    );
    let text = faults("host = \"hip\"", "host = \"hipp\"");
    assert!(text.contains("write \"hip\", the nearest one"), "{text}");
    assert!(faults("[node.central]", "[nodes.central]").contains("write node, the nearest one"));
}

#[test]
fn all_faults_are_reported_together() {
    let text = LEG.replace("95", "100").replace("[2, 3]", "[2, -3]").replace("/var/lib", "var/lib");
    let faults = read(&text).expect_err("the file has faults");
    let keys: Vec<_> = faults.faults().iter().map(|fault| fault.key.as_str()).collect();
    assert_eq!(keys, ["host.hip.folder", "node.hip.realtime_priority_max", "node.hip.cpus"]);
    assert!(faults.faults().iter().all(|fault| fault.line.is_some() && !fault.remedy.is_empty()), "{faults}");
}

#[test]
fn node_has_exactly_one_program() {
    assert!(faults("program = \"bin/central\"", "").contains("none of them, or both"));
    let both = "installed = \"/bin/x\"\nprogram = \"bin/x\"";
    assert!(faults("installed = \"/usr/bin/hip\"", both).contains("none of them, or both"));
    assert!(faults("\"/usr/bin/hip\"", "\"hip\"").contains("an absolute path"));
}

#[test]
fn circle_of_nodes_is_named() {
    let text = faults("config = \"central.toml\"", "after = [\"hip\"]");
    assert!(text.contains("a circle: central after hip after central"), "{text}");
}

#[test]
fn own_names_of_files_are_refused() {
    let text = faults("config = \"central.toml\"", "files = [\"a/map\", \"b/map\", \"log\"]");
    assert!(text.contains("\"/robot/b/map\"") && text.contains("\"/robot/log\""), "{text}");
}

#[test]
fn empty_file_needs_a_robot_and_a_node() {
    let text = read("").expect_err("nothing is there").to_string();
    assert!(
        text.contains("robot (line 1): found nothing") && text.contains("node (line 1): found nothing"),
        "{text}"
    );
    assert!(read("[robot").expect_err("it is no TOML").to_string().contains("robot.md"));
}

#[test]
fn this_host_has_a_folder_and_no_ssh() {
    let here = "[host.here]\nfolder = \"/tmp/x\"\n[node.central]";
    let robot = read(&LEG.replace("[node.central]", here)).unwrap_or_else(|faults| panic!("{faults}"));
    assert_eq!(robot.hosts[HERE].folder.as_deref(), Some("/tmp/x"));
    assert!(faults("[node.central]", "[host.here]\nssh = \"x\"\n[node.central]").contains("host.here.ssh"));
    let lacks = faults("ssh = \"robot@10.0.0.2\"", "");
    assert!(lacks.contains("host.hip.ssh") && lacks.contains("found nothing"), "{lacks}");
}
