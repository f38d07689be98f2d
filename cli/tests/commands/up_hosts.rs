//! `sinew up` on three hosts, each a network namespace with an `sshd`, from a fourth one.
//!
//! Skipped, with a printed reason, where there are no namespaces or no `sshd`.

use std::{
    fs,
    net::TcpStream,
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::Value;
use sinew_testkit::{Hosts, NodeProcess, TestDirectory, own_group, program, until};

use crate::{
    scenario::{Answer, named},
    up::runs,
};

const NAMES: [&str; 3] = ["central", "hip", "knee"];
/// Places of the program on common distributions.
const SSHD: [&str; 2] = ["/usr/sbin/sshd", "/usr/bin/sshd"];

/// The hosts, with the files of the robot.
struct Fleet {
    hosts: Hosts,
    directory: TestDirectory,
    _servers: Vec<NodeProcess>,
}

impl Fleet {
    /// Creates the hosts, or explains why that is not possible here.
    fn new() -> Result<Self, String> {
        let sshd = SSHD.iter().map(Path::new).find(|path| path.exists()).ok_or("there is no sshd")?;
        let (hosts, directory) = (Hosts::new(4)?, TestDirectory::new());
        fs::create_dir_all("/run/sshd").map_err(|error| format!("no /run/sshd: {error}"))?;
        for key in ["host_key", "user_key"] {
            let path = directory.join(key);
            let made =
                Command::new("ssh-keygen").args(["-q", "-t", "ed25519", "-N", "", "-f"]).arg(path).status();
            made.map_err(|error| format!("no ssh-keygen: {error}"))?;
        }
        let shown = |name: &str| directory.join(name).display().to_string();
        let config = directory.write(
            "sshd_config",
            &format!(
                "HostKey {}\nAuthorizedKeysFile {}\nStrictModes no\nUsePAM no\nPidFile none\nPermitRootLogin yes\n",
                shown("host_key"),
                shown("user_key.pub")
            ),
        );
        let server = |host: usize| {
            let mut command = hosts.all()[host].command(sshd);
            command.args(["-D", "-e", "-f"]).arg(&config);
            NodeProcess::start("sshd", command)
        };
        let servers: Vec<_> = (1..=NAMES.len()).map(server).collect();
        for host in hosts.all().iter().skip(1) {
            let connected = || host.run(|| TcpStream::connect((host.address, 22)).ok());
            until("sshd listens", connected);
        }
        Ok(Self { hosts, directory, _servers: servers })
    }

    /// Writes the robot and its configurations. Central requires the two others.
    fn write(&self) {
        let group = own_group();
        let options = format!(
            "[\"-i\", \"{}\", \"-o\", \"StrictHostKeyChecking=no\", \"-o\", \"UserKnownHostsFile=/dev/null\", \"-o\", \"LogLevel=ERROR\"]",
            self.directory.join("user_key").display()
        );
        let mut robot = "[robot]\nname = \"leg\"\nkeys = \"keys\"\nready_within_ms = 60000\n".to_owned();
        for (index, name) in (1..).zip(NAMES) {
            let (address, program) = (self.hosts.all()[index].address, self.directory.join(name));
            fs::copy(sinew_testkit::program("scenarios"), &program)
                .expect("build it: cargo build -p sinew-tests");
            let config = format!(
                "[node]\nname = \"{name}\"\nproject = \"leg\"\n[lncl]\nsocket = \"n.sock\"\n[security]\nkeys = \"keys\"\n\
                 [ndl]\ninterface = \"{address}\"\nmulticast = \"{group}\"\nmdns_port = false\n"
            );
            let _ = self.directory.write(&format!("{name}.toml"), &config);
            let more =
                if name == "central" { ", \"--requires\", \"hip\", \"--requires\", \"knee\"" } else { "" };
            robot += &format!(
                "[host.{name}]\nssh = \"root@{address}\"\nssh_options = {options}\nfolder = \"{}\"\n\
                 [node.{name}]\nhost = \"{name}\"\nprogram = \"{name}\"\nconfig = \"{name}.toml\"\n\
                 arguments = [\"--role\", \"node_under_test\", \"{name}.toml\"{more}]\n",
                self.folder(name).display()
            );
        }
        let _ = self.directory.write("robot.toml", &robot);
    }

    /// Returns the folder of a host: all share the file system of this machine.
    fn folder(&self, host: &str) -> PathBuf {
        self.directory.join(&format!("on-{host}"))
    }

    fn sinew(&self, words: &[&str]) -> Answer {
        let mut command = self.hosts.all()[0].command(Path::new(env!("CARGO_BIN_EXE_sinew")));
        Answer::of(command.args(words).current_dir(self.directory.join("")))
    }

    /// Checks that the keys of a node are on its host alone.
    fn check_keys(&self) {
        for name in NAMES {
            let key =
                fs::read(self.directory.join(&format!("keys/nodes/{name}/node.key"))).expect("it was made");
            for host in NAMES {
                let has_key =
                    files(&self.folder(host)).iter().any(|file| fs::read(file).is_ok_and(|text| text == key));
                assert_eq!(has_key, host == name, "the key of {name} on host {host}");
            }
        }
    }

    fn processes(&self) -> Vec<u64> {
        let status = self.sinew(&["status", "--json"]).json();
        let process = |name| named(&status["nodes"], name).and_then(|node: &Value| node["process"].as_u64());
        NAMES.map(|name| process(name).unwrap_or_else(|| panic!("{name} does not run: {status}"))).to_vec()
    }
}

impl Drop for Fleet {
    fn drop(&mut self) {
        // A test that has failed leaves no processes.
        let _ = self.sinew(&["down"]);
    }
}

/// Returns the paths of all files below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

#[test]
fn robot_on_three_hosts_survives_each_fault() {
    let fleet = match Fleet::new() {
        Ok(fleet) => fleet,
        Err(why) => {
            println!("skipped: no hosts with sshd can be made here: {why}");
            return;
        }
    };
    fleet.write();
    let pairs: Vec<_> =
        (1..).zip(NAMES).map(|(host, name)| format!("{name}={}", fleet.hosts.all()[host].address)).collect();
    let words =
        [&["keys", "init", "leg"][..], &pairs.iter().map(String::as_str).collect::<Vec<_>>()].concat();
    let keys = fleet.sinew(&words);
    assert_eq!(keys.code, Some(0), "{}{}", keys.out, keys.err);
    // From nothing to a robot that runs: also the command itself is copied.
    let up = fleet.sinew(&["up"]);
    assert!(
        up.code == Some(0) && up.out.ends_with("released: all 3 nodes are ready\n"),
        "{}{}",
        up.out,
        up.err
    );
    let first = fleet.processes();
    fleet.check_keys();
    // One program changes.
    let mut changed = fs::read(program("scenarios")).expect("it was copied before");
    changed.extend_from_slice(b"new");
    fs::write(fleet.directory.join("knee"), changed).expect("the test's own file");
    let change = fleet.sinew(&["up"]);
    assert!(
        change.code == Some(0) && change.out.contains("knee: 1 files sent"),
        "{}{}",
        change.out,
        change.err
    );
    let second = fleet.processes();
    assert!(first[..2] == second[..2] && first[2] != second[2], "{first:?} {second:?}");
    // One host is not reachable: it is named, and nothing changes.
    fleet.hosts.cut(3);
    let lost = fleet.sinew(&["up"]);
    assert_eq!(lost.code, Some(1), "{}", lost.out);
    for words in
        ["nothing was changed:", "host knee is not reachable:", "ssh -o BatchMode=yes root@10.77.0.4 true"]
    {
        assert!(lost.err.contains(words), "{words}: {}", lost.err);
    }
    let status = fleet.sinew(&["status", "--json"]).json();
    let state = |name| named(&status["nodes"], name).expect("it is in the file")["state"].clone();
    assert_eq!((state("hip"), state("knee")), ("ready".into(), "unknown".into()), "{status}");
    fleet.hosts.join(3);
    // One key is missing.
    let key = fleet.directory.join("keys/nodes/knee/node.key");
    let kept = fs::read(&key).expect("it was made");
    fs::remove_file(&key).expect("it was made");
    let missing = fleet.sinew(&["up"]);
    assert!(missing.code == Some(1) && missing.err.contains("lack node.key"), "{}", missing.err);
    fs::write(&key, kept).expect("the test's own file");
    // Down: nothing is left on any host.
    let down = until("all hosts are reachable again", || {
        Some(fleet.sinew(&["down"])).filter(|down| down.code == Some(0))
    });
    assert!(down.out.ends_with("leg: nothing is left\n"), "{}{}", down.out, down.err);
    for name in NAMES {
        assert!(!fleet.folder(name).exists(), "files of {name} are left: {:?}", files(&fleet.folder(name)));
    }
    assert!(!second.iter().any(|process| runs(*process)), "{second:?}");
}
