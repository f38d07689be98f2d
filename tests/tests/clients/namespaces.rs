//! A node in a namespace of its own: the kernel reports no process ID for a client, or one user ID for many
//! users.

use sinew_tests::role;
use std::{os::unix::net::UnixStream, process::Command};

use rustix::process::{Pid, Signal, kill_process};
use sinew::{Endpoint, NodeApi, Registration};
use sinew_testkit::{
    NodeProcess, TestDirectory, own_group,
    sandbox::{in_own_pid_namespace, in_own_user_namespace},
    until,
};

/// More than one process may have (`lncl.clients_per_process_max`, 64).
const CLIENTS: usize = 70;

/// `None` if no namespace can be created.
fn node(directory: &TestDirectory) -> Option<(NodeProcess, NodeApi)> {
    node_in(directory, in_own_pid_namespace(&role("node_under_test")))
}

fn node_in(directory: &TestDirectory, command: Option<Command>) -> Option<(NodeProcess, NodeApi)> {
    let mut command = command?;
    let (config, socket) = (directory.join("knee.toml"), directory.join("knee.sock"));
    let text = format!(
        "[node]\nname = \"knee\"\naddress = \"127.0.0.1\"\nproject = \"namespaces\"\n[lncl]\nsocket = {socket:?}\n\
         [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        own_group()
    );
    std::fs::write(&config, text).expect("the test's own directory");
    command.arg(&config).arg("--logs");
    let mut node = NodeProcess::start("knee", command);
    node.wait_for(&["up"]);
    Some((node, NodeApi::connect(socket).expect("the node is up")))
}

#[test]
fn clients_of_other_pid_namespaces_are_counted_apart() {
    let directory = TestDirectory::new();
    let Some((_node, api)) = node(&directory) else { return };
    let register = |_| api.register_transport_address(Registration::new());
    let endpoints: Result<Vec<Endpoint>, _> = (0..CLIENTS).map(register).collect();
    assert_eq!(endpoints.map(|all| all.len()).map_err(|error| error.to_string()), Ok(CLIENTS));
}

// spec: LNCL-15
#[test]
fn killed_client_of_other_pid_namespace_frees_its_name() {
    let (own, _peer) = UnixStream::pair().expect("two sockets");
    if let Err(error) = sinew_shm::peer_pidfd(&own) {
        println!("skipped: this kernel has no SO_PEERPIDFD: {error}");
        return;
    }
    let directory = TestDirectory::new();
    let Some((_node, api)) = node(&directory) else { return };
    let mut command = role("taker");
    command.arg(directory.join("knee.sock")).arg("drive");
    let mut client = NodeProcess::start("drive", command);
    client.wait_for(&["up"]);
    client.send_line("fork");
    let forked = client.wait_for(&["forked"]);
    let child = forked.split_whitespace().last().and_then(|pid| Pid::from_raw(pid.parse().ok()?));

    client.signal(Signal::KILL);

    let _drive =
        until("its name is free", || api.register_transport_address(Registration::new().name("drive")).ok());
    kill_process(child.expect("a process id"), Signal::KILL).expect("the child lives all the time");
}

/// The kernel reports this user ID for each user that a user namespace does not map.
const OVERFLOW_USER: u32 = 65_534;

#[test]
fn unmapped_user_is_not_taken_for_the_nodes_own() {
    let directory = TestDirectory::new();
    let command = in_own_user_namespace(&role("node_under_test"), OVERFLOW_USER);
    let Some((_node, api)) = node_in(&directory, command) else { return };
    let refused = api.register_transport_address(Registration::new()).expect_err("it may be any user");
    let words = refused.to_string();
    assert!(words.contains("stands for every user") && words.contains("65534"), "{words}");
}
