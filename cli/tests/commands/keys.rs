//! `sinew keys` as a process: its files, their permissions, protection from overwriting, and nodes that load them.

use std::{
    fs,
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
    process::{Command, Output},
    sync::Arc,
};

use serde_json::Value;
use sinew::security::{
    Credentials, Identity, TimePolicy, Tls, UnixTime,
    rustls::{ClientConnection, ServerConnection, time_provider::DefaultTimeProvider},
};
use sinew_testkit::TestDirectory;

use crate::scenario::{Answer, named};

/// Runs `sinew keys` in `directory`.
fn keys(directory: &TestDirectory, words: &[&str]) -> Answer {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    command.arg("keys").args(words).current_dir(directory.join("."));
    let Output { status, stdout, stderr } = command.output().expect("the command starts");
    let text = |bytes| String::from_utf8(bytes).expect("it writes text");
    Answer { code: status.code(), out: text(stdout), err: text(stderr) }
}

/// Returns the JSON of a successful command.
#[track_caller]
fn good(directory: &TestDirectory, words: &[&str]) -> Value {
    let answer = keys(directory, &[words, &["--json"]].concat());
    assert_eq!(answer.code, Some(0), "{words:?}: {}{}", answer.out, answer.err);
    answer.json()
}

/// Expects a refusal with this exit code and these parts.
#[track_caller]
fn refused(directory: &TestDirectory, words: &[&str], code: i32, parts: &[&str]) {
    let answer = keys(directory, words);
    assert_eq!(answer.code, Some(code), "{words:?}: {}{}", answer.out, answer.err);
    for part in parts {
        assert!(answer.err.contains(part), "{part}: {}", answer.err);
    }
}

fn mode(path: &Path) -> u32 {
    fs::metadata(path).unwrap_or_else(|why| panic!("{}: {why}", path.display())).permissions().mode() & 0o7777
}

/// Every file and directory below `path`, with its mode and content.
fn everything(path: &Path) -> Vec<(PathBuf, u32, Vec<u8>)> {
    let mut all = Vec::new();
    for entry in fs::read_dir(path).expect("a directory") {
        let path = entry.expect("an entry").path();
        let content = fs::read(&path).unwrap_or_default();
        if path.is_dir() {
            all.extend(everything(&path));
        }
        all.push((path.clone(), mode(&path), content));
    }
    all.sort();
    all
}

fn credentials(directory: &TestDirectory, name: &str, address: [u8; 4]) -> Credentials {
    let identity = Identity { project: "walker".to_owned(), address: address.into(), name: name.to_owned() };
    let path = directory.join("keys").join("nodes").join(name);
    Credentials::load(&path, &identity, TimePolicy::Strict, UnixTime::now()).expect("nodes take it")
}

#[test]
fn init_with_four_names_makes_a_connecting_robot() {
    // Given: nothing
    let directory = TestDirectory::new();
    // When
    let json = good(&directory, &["init", "walker", "hip", "knee", "ankle", "central"]);
    // Then: the nodes share this machine, with addresses in order
    let addresses: Vec<_> =
        json["nodes"].as_array().expect("nodes").iter().map(|node| &node["address"]).collect();
    assert_eq!(addresses, ["127.0.0.1", "127.0.0.2", "127.0.0.3", "127.0.0.4"]);
    let hip = named(&json["nodes"], "hip").expect("it");
    assert_eq!(hip["copy"], "keys/nodes/hip");
    // And: two of them connect
    let tls = |name: &str, last| {
        let credentials = credentials(&directory, name, [127, 0, 0, last]);
        Tls::new(&credentials, Arc::new(DefaultTimeProvider)).expect("a good key")
    };
    let (hip, central) = (tls("hip", 1), tls("central", 4));
    let mut client = ClientConnection::new(hip.client(), Tls::server_name()).expect("a client");
    let mut server = ServerConnection::new(central.server()).expect("a server");
    while client.is_handshaking() || server.is_handshaking() {
        let mut bytes = Vec::new();
        client.write_tls(&mut bytes).expect("memory");
        server.read_tls(&mut &bytes[..]).expect("memory");
        server.process_new_packets().expect("a good client");
        bytes.clear();
        server.write_tls(&mut bytes).expect("memory");
        client.read_tls(&mut &bytes[..]).expect("memory");
        client.process_new_packets().expect("a good server");
    }
    let peer = hip.peer(&client, Some([127, 0, 0, 4].into()), UnixTime::now()).expect("the central node");
    assert_eq!(peer.identity.name, "central");
}

#[test]
fn files_have_restrictive_modes_and_nothing_else_is_left() {
    let directory = TestDirectory::new();
    good(&directory, &["init", "walker", "hip=10.0.0.2", "--out", "mine"]);
    let keys = directory.join("mine");
    assert_eq!(mode(&keys), 0o700);
    let all = everything(&keys);
    let names: Vec<_> = all
        .iter()
        .map(|(path, mode, _)| format!("{} {mode:o}", path.strip_prefix(&keys).expect("inside").display()))
        .map(|name| if name.starts_with("issued/") { "issued/.pem 644".to_owned() } else { name })
        .collect();
    let expected = [
        "ca.key 600",
        "ca.pem 644",
        "denied.txt 644",
        "discovery.key 600",
        "issued 700",
        "issued/.pem 644",
        "nodes 700",
        "nodes/hip 700",
        "nodes/hip/ca.pem 644",
        "nodes/hip/denied.txt 644",
        "nodes/hip/discovery.key 600",
        "nodes/hip/node.key 600",
        "nodes/hip/node.pem 644",
    ];
    assert_eq!(names, expected);
    assert_eq!(fs::read_dir(directory.join(".")).expect("it").count(), 1, "nothing beside it");
    // The authority's key is in no node's directory.
    let authority = fs::read(keys.join("ca.key")).expect("it");
    assert_eq!(all.iter().filter(|(_, _, content)| *content == authority).count(), 1);
}

#[test]
fn existing_files_are_never_overwritten_silently() {
    let directory = TestDirectory::new();
    good(&directory, &["init", "walker", "hip"]);
    let before = everything(&directory.join("keys"));
    refused(&directory, &["init", "walker", "hip"], 1, &["keys of a project", "sinew keys issue", "--out"]);
    fs::create_dir(directory.join("full")).expect("it");
    fs::write(directory.join("full").join("notes.txt"), "mine").expect("it");
    refused(&directory, &["init", "walker", "hip", "--out", "full"], 1, &["no empty directory", "--out"]);
    fs::write(directory.join("file"), "mine").expect("it");
    refused(&directory, &["init", "walker", "hip", "--out", "file"], 1, &["no empty directory"]);
    refused(&directory, &["init", "walker", "hip", "--out", "no/where"], 1, &["No such file"]);
    assert_eq!(everything(&directory.join("keys")), before);
    assert_eq!(fs::read_dir(directory.join("full")).expect("it").count(), 1);
    // An empty directory counts as absent.
    fs::create_dir(directory.join("empty")).expect("it");
    good(&directory, &["init", "walker", "hip", "--out", "empty"]);
    assert_eq!(mode(&directory.join("empty")), 0o700);
}

#[test]
fn invalid_names_and_addresses_are_refused_before_any_write() {
    let directory = TestDirectory::new();
    for (nodes, parts) in [
        (&["hip=10.0.0.2", "knee=10.0.0.2"][..], &["'hip' and 'knee' have the same address, 10.0.0.2"][..]),
        (&["hip", "hip"], &["'hip' is named twice"]),
        (&["hip=10.0.0.2", "hip=10.0.0.2"], &["'hip' is named twice"]),
        (&["hip=10.0.0.2", "knee"], &["which address 'knee' has", "'hip' has 10.0.0.2", "knee=ADDRESS"]),
        (&["hip=10.0.0"], &["'10.0.0' is no address", "hip=192.168.0.11"]),
        (&["hip=0.0.0.0"], &["node.address"]),
        // The grammar of names is that of nodes, with the same messages.
        (&["../hip"], &["no node can be called `../hip`", "'/'"]),
        (&[".."], &["no node can be called `..`", "'.'"]),
        (&[".hip"], &["no node can be called `.hip`", "'.'"]),
        (&["a/b=10.0.0.2"], &["no node can be called `a/b`", "'/'"]),
        (&["a=b=10.0.0.2"], &["no node can be called `a=b`", "'='"]),
        (&["x.toml=10.0.0.2"], &["no node can be called `x.toml`", ".toml"]),
        (&["--", "-x=10.0.0.2"], &["no node can be called `-x`", "'-'"]),
        (&["-x=10.0.0.2"], &["-- -x"]),
        (&[&"k".repeat(64)], &["it has 64 bytes, and a name has at most 63"]),
        (&[""], &["no node can be called ``", "it is empty"]),
        (&["nowhere.toml"], &["nowhere.toml", "this is no configuration of a node"]),
    ] {
        refused(&directory, &[&["init", "walker"], nodes].concat(), 2, parts);
    }
    refused(&directory, &["init", "", "hip"], 2, &["no project can be called ``", "it is empty"]);
    refused(&directory, &["init", "a/b", "hip"], 2, &["no project can be called `a/b`"]);
    assert_eq!(fs::read_dir(directory.join(".")).expect("it").count(), 0, "nothing was made");
}

#[test]
fn address_is_read_from_the_configuration_of_the_node() {
    let directory = TestDirectory::new();
    let config = |name: &str, text: &str| fs::write(directory.join(name), text).expect("it");
    config("knee.toml", "[node]\nname = 'knee'\nproject = 'walker'\naddress = '10.0.0.3'\n");
    config("left.toml", "[node]\nname = 'ankle'\nproject = 'walker'\n[ndl]\ninterface = '192.168.0.14'\n");
    config("other.toml", "[node]\nname = 'other'\nproject = 'runner'\n");
    config("wrong.toml", "[node]\nname = 'right'\nproject = 'walker'\n");
    let json = good(&directory, &["init", "walker", "knee", "left.toml", "wrist=127.0.0.1", "hip"]);
    for (name, address, from) in [
        ("knee", "10.0.0.3", "from knee.toml"),
        ("ankle", "192.168.0.14", "from left.toml"),
        ("hip", "127.0.0.2", "next free here"),
    ] {
        let node = named(&json["nodes"], name).expect("it");
        assert_eq!((&node["address"], &node["address_from"]), (&address.into(), &from.into()), "{node}");
    }
    refused(
        &directory,
        &["init", "walker", "other.toml", "--out", "o"],
        2,
        &["of project 'runner'", "'walker'"],
    );
    refused(&directory, &["init", "walker", "wrong", "--out", "o"], 2, &["called 'right'"]);
}

#[test]
fn printed_configuration_secures_a_node() {
    let directory = TestDirectory::new();
    let answer = keys(&directory, &["init", "walker", "hip=10.0.0.9", "knee=127.0.0.1"]);
    for part in [
        "keep it off the robot",
        "tar -C keys/nodes/hip -c . | ssh root@10.0.0.9",
        "keys = \"/etc/sinew/keys\"",
        "  [ndl]\n  interface = \"10.0.0.9\"  # an address of the node's own host\n  mdns_port = false\n",
    ] {
        assert!(answer.out.contains(part), "{part}: {}", answer.out);
    }
    assert!(!answer.out.contains("tar -C keys/nodes/knee"), "what stays here is not copied: {}", answer.out);
    // A node of this machine loads its keys from their place in the project's directory.
    let lines =
        good(&directory, &["issue", "knee"])["nodes"][0]["configuration"].as_str().expect("lines").to_owned();
    let mut config = sinew::NodeConfig::from_toml(&lines).expect("legal");
    assert!(config.ndl.mdns_port.is_some(), "nobody else hears it there: {lines}");
    assert!(config.ndl.interface.are_default(), "loopback is the default: {lines}");
    // On a network the node is reachable, and multicast DNS is off because it bypasses the keys.
    let lines = &good(&directory, &["issue", "hip"])["nodes"][0]["configuration"];
    let on_a_network = sinew::NodeConfig::from_toml(lines.as_str().expect("lines")).expect("legal");
    assert_eq!(on_a_network.ndl.interface.to_string(), "10.0.0.9", "{lines}");
    assert_eq!(on_a_network.ndl.mdns_port, None, "{lines}");
    let path = config.security.keys.clone().expect("keys");
    assert!(path.is_absolute() && path.ends_with("keys/nodes/knee"), "{}", path.display());
    let identity = Identity {
        project: config.project.clone(),
        address: config.node_address(),
        name: config.name.clone(),
    };
    let loaded = Credentials::load(&path, &identity, config.security.times, UnixTime::now());
    assert_eq!(loaded.expect("they are its own").warnings(), [""; 0]);
    // Then: the node starts with these keys
    config.ndl.multicast = None;
    config.ndl.mdns_port = None;
    let node = sinew::Node::builder("knee").configure(|own| *own = config).start();
    assert_eq!(node.expect("its keys are its own").stop(), sinew::node::NodeEnd::Stopped);
}

#[test]
fn issue_adds_and_renews_nodes_and_lists_valid_certificates() {
    let directory = TestDirectory::new();
    good(&directory, &["init", "walker", "hip=127.0.0.1", "knee=10.0.0.3"]);
    let first = credentials(&directory, "knee", [10, 0, 0, 3]).serial().to_string();
    // When: one more node, and the knee again
    let json = good(&directory, &["issue", "ankle", "knee", "--days", "30"]);
    // Then
    assert_eq!(named(&json["nodes"], "ankle").expect("it")["address"], "127.0.0.2");
    let knee = named(&json["nodes"], "knee").expect("it");
    assert_eq!((&knee["address"], &knee["address_from"]), (&"10.0.0.3".into(), &"as before".into()));
    assert_eq!(json["older"][0]["number"], first.as_str());
    assert_ne!(credentials(&directory, "knee", [10, 0, 0, 3]).serial().to_string(), first);
    assert_eq!(mode(&directory.join("keys/nodes/knee")), 0o700);
    assert_eq!(fs::read_dir(directory.join("keys/nodes")).expect("it").count(), 3, "nothing is left over");
    // And: an address of another node is refused
    refused(&directory, &["issue", "hip=10.0.0.3"], 2, &["'knee' and 'hip' have the same address"]);
    refused(&directory, &["issue", "wrist", "--keys", "elsewhere"], 1, &["elsewhere", "--keys DIR"]);
}

#[test]
fn revoked_node_is_shown_and_on_every_list() {
    let directory = TestDirectory::new();
    good(&directory, &["init", "walker", "hip", "knee"]);
    let other = credentials(&directory, "knee", [127, 0, 0, 2]);
    let serial = credentials(&directory, "hip", [127, 0, 0, 1]).serial().to_string();
    refused(
        &directory,
        &["revoke", "hip", "wrist"],
        1,
        &["no certificate of `wrist`", "Nothing was revoked"],
    );
    refused(&directory, &["revoke", "kneee"], 1, &["no certificate of `kneee`", "nearest: knee"]);
    assert!(credentials(&directory, "hip", [127, 0, 0, 1]).validity().until > UnixTime::now());
    // When
    let json = good(&directory, &["revoke", "hip"]);
    // Then: the number is on every list
    assert_eq!(json["revoked"][0]["number"], serial.as_str());
    for list in ["keys/denied.txt", "keys/nodes/hip/denied.txt", "keys/nodes/knee/denied.txt"] {
        let text = fs::read_to_string(directory.join(list)).expect("it");
        assert!(text.contains(&serial) && text.contains("hip 127.0.0.1, revoked 20"), "{list}: {text}");
    }
    // And: the revocation is shown
    let shown = keys(&directory, &["show", "--json"]);
    assert_eq!(shown.code, Some(1), "a node without a certificate that counts is a finding");
    let hip = named(&shown.json()["certificates"], "hip").expect("it").clone();
    assert_eq!((&hip["state"], &hip["revoked"]), (&"revoked".into(), &true.into()));
    // And: a second revocation changes nothing
    let again = good(&directory, &["revoke", &serial]);
    assert_eq!(
        (again["revoked"].as_array().map(Vec::len), &again["revoked_before"][0]["name"]),
        (Some(0), &"hip".into())
    );
    // And: a new certificate is valid beside it
    good(&directory, &["issue", "hip"]);
    assert_eq!(good(&directory, &["show"])["denied"], 1);
    assert!(credentials(&directory, "hip", [127, 0, 0, 1]).serial().to_string() != serial);
    drop(other);
}

#[test]
fn revoke_prints_a_copy_command_for_each_remaining_node() {
    let directory = TestDirectory::new();
    good(&directory, &["init", "walker", "hip=10.0.0.2", "knee=10.0.0.3", "ankle=127.0.0.4"]);
    let answer = keys(&directory, &["revoke", "hip"]);
    let copies: Vec<_> = answer.out.lines().filter(|line| line.contains("ssh")).collect();
    // No command for the revoked node, nor for the node of this machine, which has its directory here.
    assert_eq!(copies.len(), 1, "{}", answer.out);
    assert!(copies[0].starts_with("  tar -C keys -c denied.txt | ssh root@10.0.0.3 '"), "{}", answer.out);
    // And: a node with a new certificate counts as remaining again, at its previous address
    let json = good(&directory, &["issue", "hip"]);
    let hip = named(&json["nodes"], "hip").expect("it");
    assert_eq!((&hip["address"], &hip["address_from"]), (&"10.0.0.2".into(), &"as before".into()));
    let answer = keys(&directory, &["revoke", "knee"]);
    let copies: Vec<_> = answer.out.lines().filter(|line| line.contains("ssh")).collect();
    assert!(copies.len() == 1 && copies[0].contains("root@10.0.0.2"), "{}", answer.out);
}

/// A machine that the printed commands reach by `ssh`: its `/etc/sinew/keys`, and the connection to it.
struct Robot<'a> {
    directory: &'a TestDirectory,
    keys: PathBuf,
}

impl<'a> Robot<'a> {
    fn new(directory: &'a TestDirectory) -> Self {
        fs::create_dir(directory.join("bin")).expect("it");
        Self { directory, keys: directory.join("robot/etc/keys") }
    }

    /// Runs the line of `output` for that machine, and passes its bytes through the command `way`. Returns whether it
    /// succeeded.
    fn takes(&self, output: &str, way: &str) -> bool {
        let ssh = self.directory.join("bin/ssh");
        fs::write(&ssh, format!("#!/bin/sh\n{way} | sh -c \"$2\"\n")).expect("it");
        fs::set_permissions(&ssh, fs::Permissions::from_mode(0o755)).expect("it");
        let line = output.lines().find(|line| line.contains("| ssh root@")).expect("a command");
        let line = line.replace("/etc/sinew/keys", self.keys.to_str().expect("a path of the test's own"));
        let path =
            format!("{}:{}", self.directory.join("bin").display(), std::env::var("PATH").expect("one"));
        let mut shell = Command::new("sh");
        shell.args(["-c", &line]).env("PATH", path).current_dir(self.directory.join("."));
        shell.output().expect("a shell").status.success()
    }

    fn denied(&self) -> String {
        fs::read_to_string(self.keys.join("denied.txt")).expect("it")
    }
}

#[test]
fn truncated_deny_list_leaves_the_previous_files() {
    let directory = TestDirectory::new();
    let robot = Robot::new(&directory);
    // Given: a node with its keys installed
    let made = keys(&directory, &["init", "walker", "hip=10.0.0.2", "knee=10.0.0.3"]);
    assert!(robot.takes(&made.out, "cat"), "{}", made.out);
    assert_eq!(mode(&robot.keys), 0o700);
    assert_eq!(everything(&robot.keys).len(), 5);
    let empty = robot.denied();
    // When: a list arrives truncated
    let revoked = keys(&directory, &["revoke", "hip"]);
    assert!(!robot.takes(&revoked.out, "head -c 600"), "the command reports the failure");
    // Then: the node keeps the previous list
    assert_eq!(robot.denied(), empty);
    // And: it accepts the new list when that arrives complete, and no temporary files remain
    assert!(robot.takes(&revoked.out, "cat"));
    assert_eq!(robot.denied(), fs::read_to_string(directory.join("keys/denied.txt")).expect("it"));
    assert_ne!(robot.denied(), empty);
    assert_eq!(everything(&robot.keys).len(), 5);
    assert_eq!(mode(&robot.keys.join("node.key")), 0o600);
}

/// Length of the archive that `tar` makes of `directory`, up to the second file in it.
fn length_of_the_first_file_of(directory: &Path) -> usize {
    const BLOCK: usize = 512;
    let mut tar = Command::new("tar");
    let archive = tar.arg("-C").arg(directory).args(["-c", "."]).output().expect("tar").stdout;
    // The directory itself is first. POSIX, pax, "ustar Interchange Format": the size in octal at 124.
    let size = std::str::from_utf8(&archive[BLOCK + 124..BLOCK + 135]).expect("digits");
    let size = usize::from_str_radix(size, 8).expect("octal digits");
    assert!(2 * BLOCK + size < archive.len(), "there are more");
    2 * BLOCK + size.next_multiple_of(BLOCK)
}

#[test]
fn archive_truncated_between_files_leaves_the_previous_files() {
    let directory = TestDirectory::new();
    let robot = Robot::new(&directory);
    let made = keys(&directory, &["init", "walker", "hip=10.0.0.2"]);
    assert!(robot.takes(&made.out, "cat"), "{}", made.out);
    let before = everything(&robot.keys);
    // When: a new certificate's directory arrives, cut so that `tar` accepts it as complete
    let issued = keys(&directory, &["issue", "hip"]);
    let length = length_of_the_first_file_of(&directory.join("keys/nodes/hip"));
    assert!(!robot.takes(&issued.out, &format!("head -c {length}")), "the command reports the failure");
    // Then
    let after: Vec<_> = everything(&robot.keys);
    assert!(before.iter().all(|file| after.contains(file)), "{after:?}");
    // And: it accepts the complete directory, with its different content
    assert!(robot.takes(&issued.out, "cat"), "{}", issued.out);
    let after = everything(&robot.keys);
    assert!(after.len() == before.len() && after != before);
}

#[test]
fn tables_fit_a_terminal_for_any_names() {
    let directory = TestDirectory::new();
    let name = "left-knee.".repeat(7).chars().take(63).collect::<String>();
    let node = format!("{name}=192.168.100.200");
    let fits = |table: &str| table.lines().all(|line| line.chars().count() <= 120);
    let made = keys(&directory, &["init", "walker", &node]);
    let table = made.out.split("\n\n").find(|part| part.starts_with("NODE")).expect("a table");
    assert!(made.code == Some(0) && fits(table), "{}{}", made.out, made.err);
    let shown = keys(&directory, &["show"]);
    assert!(shown.code == Some(0) && fits(&shown.out) && !shown.out.contains("FROM"), "{}", shown.out);
    let wide = keys(&directory, &["show", "--wide"]);
    assert!(wide.out.contains("FROM") && wide.out.contains(&name), "{}", wide.out);
}

#[test]
fn show_lists_nodes_and_expiry_also_on_the_robot() {
    let directory = TestDirectory::new();
    good(&directory, &["init", "walker", "hip=10.0.0.2"]);
    let answer = keys(&directory, &["show"]);
    let lines: Vec<_> = answer.out.lines().collect();
    assert!(
        answer.code == Some(0) && lines[0].contains("Project walker, authority until 20"),
        "{}",
        answer.out
    );
    assert!(
        lines[3].starts_with("hip") && lines[3].contains("10.0.0.2") && lines[3].ends_with("good"),
        "{}",
        answer.out
    );
    // On the robot: the directory of the node alone
    let json = good(&directory, &["show", "--keys", "keys/nodes/hip"]);
    assert_eq!(json["certificates"].as_array().map(Vec::len), Some(1));
    // And: a certificate that expires soon is a finding
    good(&directory, &["issue", "hip", "--days", "3"]);
    let soon = keys(&directory, &["show"]);
    assert!(soon.code == Some(1) && soon.out.contains("good, ends soon"), "{}", soon.out);
    refused(&directory, &["show", "--keys", "nowhere"], 1, &["nowhere/ca.pem", "No such file"]);
}

#[test]
fn directory_accessible_to_others_is_refused() {
    let directory = TestDirectory::new();
    good(&directory, &["init", "walker", "hip"]);
    let key = directory.join("keys/ca.key");
    fs::set_permissions(&key, fs::Permissions::from_mode(0o644)).expect("it");
    refused(&directory, &["issue", "knee"], 1, &["ca.key", "0644", "chmod 600"]);
    fs::set_permissions(&key, fs::Permissions::from_mode(0o600)).expect("it");
    let own = directory.join("keys");
    fs::set_permissions(&own, fs::Permissions::from_mode(0o770)).expect("it");
    refused(&directory, &["revoke", "hip"], 1, &["others can write to keys", "0770", "chmod go-w"]);
    fs::set_permissions(&own, fs::Permissions::from_mode(0o700)).expect("it");
    // And: two commands at once exclude each other
    let opened = fs::File::open(directory.join("keys")).expect("it");
    rustix::fs::flock(&opened, rustix::fs::FlockOperation::LockExclusive).expect("it");
    refused(&directory, &["issue", "knee"], 1, &["another `sinew keys` is at work"]);
    drop(opened);
    good(&directory, &["issue", "knee"]);
}
