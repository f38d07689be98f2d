//! A node in a PID namespace of its own: the kernel gives it no number of a client's process.

use std::os::unix::net::UnixStream;

use rustix::process::{Pid, Signal, kill_process};
use sinew::{Endpoint, NodeApi, Registration};
use sinew_tests::{OwnDirectory, Program, own_group, program, sandbox::in_own_pid_namespace, until};

/// More than one process may have (`lncl.clients_per_process_max`, 64).
const CLIENTS: usize = 70;

/// `None` where no namespace can be made.
fn node(directory: &OwnDirectory) -> Option<(Program, NodeApi)> {
    let (config, socket) = (directory.join("knee.toml"), directory.join("knee.sock"));
    let text = format!(
        "[node]\nname = \"knee\"\naddress = \"127.0.0.1\"\nproject = \"namespaces\"\n[lncl]\nsocket = {socket:?}\n\
         [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        own_group()
    );
    std::fs::write(&config, text).expect("the test's own directory");
    let mut command = in_own_pid_namespace(&program("node_under_test"))?;
    command.arg(&config).arg("--logs");
    let mut node = Program::start("knee", command);
    node.wait_for(&["up"]);
    Some((node, NodeApi::connect(socket).expect("the node is up")))
}

#[test]
fn clients_of_other_pid_namespaces_are_not_counted_as_one_process() {
    let directory = OwnDirectory::new();
    let Some((_node, api)) = node(&directory) else { return };
    let register = |_| api.register_transport_address(Registration::new());
    let endpoints: Result<Vec<Endpoint>, _> = (0..CLIENTS).map(register).collect();
    assert_eq!(endpoints.map(|all| all.len()).map_err(|error| error.to_string()), Ok(CLIENTS));
}

// spec: LNCL-15
#[test]
fn the_name_of_a_killed_client_of_another_pid_namespace_is_free_although_its_child_holds_the_socket() {
    let (own, _peer) = UnixStream::pair().expect("two sockets");
    if let Err(error) = sinew_shm::peer_pidfd(&own) {
        println!("skipped: this kernel has no SO_PEERPIDFD: {error}");
        return;
    }
    let directory = OwnDirectory::new();
    let Some((_node, api)) = node(&directory) else { return };
    let mut command = std::process::Command::new(program("client_kills"));
    command.args(["--role", "taker"]).arg(directory.join("knee.sock")).arg("drive");
    let mut client = Program::start("drive", command);
    client.wait_for(&["up"]);
    client.tell("fork");
    let forked = client.wait_for(&["forked"]);
    let child = forked.split_whitespace().last().and_then(|pid| Pid::from_raw(pid.parse().ok()?));

    client.signal(Signal::KILL);

    let _drive =
        until("its name is free", || api.register_transport_address(Registration::new().name("drive")).ok());
    kill_process(child.expect("a process id"), Signal::KILL).expect("the child lives all the time");
}
