//! An access list between whole nodes: default deny, and a changed list without a restart.

use std::{os::unix::fs::PermissionsExt, path::Path};

use sinew::{
    Endpoint, NodeApi, Registration,
    message::Rejection,
    node::{AccessError, AccessSummary},
    prelude::*,
};
use sinew_testkit::{DEADLINE, Loopback, TestDirectory, until};

payload!("access.torque", Control => struct Torque { newton_metres: f64 });

/// Accepts every torque.
struct Drive;

impl Actor for Drive {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Torque>> for Drive {
    type Result = ();

    fn handle(&mut self, _: Delivery<Torque>, _: &mut Self::Context) {}
}

const OPEN: &str = "[[rule]]\nfrom = ['gait@127.0.0.1']\nto = ['drive']\nclasses = ['control']\n";
const SHUT: &str = "[[rule]]\nname = 'nobody'\nfrom = ['*']\nto = ['*']\naction = 'refuse'\n";

fn write(path: &Path, list: &str) {
    std::fs::write(path, list).expect("the test's own directory");
}

fn send(gait: &mut Endpoint, to: Tid) -> Outcome {
    let torque = Torque { newton_metres: 1.0 };
    gait.message(to, &torque).confirmed(DEADLINE).expect("it is sent")
}

#[test]
fn only_listed_senders_reach_a_drive() {
    // Given: a drive behind an access list, and two applications of another node, one of which is listed
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let (list, socket) = (directory.join("access.toml"), directory.join("hip.sock"));
    write(&list, OPEN);
    let hip = loopback.node("hip").configure(|config| config.lncl.socket = Some(socket.clone()));
    let hip = hip.start().expect("a node");
    let knee = loopback.node("knee").configure(|config| config.security.access = Some(list.clone()));
    let knee = knee.app(AppSpec::new("drive", || Drive).handles::<Torque>()).start().expect("a node");
    let api = NodeApi::connect(&socket).expect("its door");
    let register = |name| {
        let registration = Registration::new().name(name).requires(["drive"]).deadline(DEADLINE);
        api.register_transport_address(registration).expect("it is registered")
    };
    let (mut gait, mut log) = (register("gait"), register("log"));
    let drive = gait.resolve("drive", DEADLINE).expect("an answer").expect("it is there");
    // Then: as soon as the knee knows the name, and never for the other one
    until("the knee knows the name", || (send(&mut gait, drive) == Outcome::Delivered).then_some(()));
    let not_allowed = Outcome::Rejected(Rejection::NotAllowed);
    let before = knee.handle().refused();
    assert_eq!(send(&mut log, drive), not_allowed);
    assert!(knee.handle().refused() > before, "it is counted");
    // When: another list
    write(&list, SHUT);
    assert_eq!(knee.handle().reload_access().expect("it is good"), AccessSummary { rules: 1, clients: 0 });
    assert_eq!(send(&mut gait, drive), not_allowed);
    // When: an invalid list, which changes nothing
    write(&list, "[[rule]]\nfrom = ['*']\nto = ['*']\nclasses = ['fast']\n");
    let faults = knee.handle().reload_access().expect_err("there is no such class").to_string();
    assert!(faults.contains("line 4") && faults.contains("access.toml"), "{faults}");
    assert_eq!(send(&mut gait, drive), not_allowed);
    write(&list, OPEN);
    knee.handle().reload_access().expect("it is good");
    assert_eq!(send(&mut gait, drive), Outcome::Delivered);
    drop((gait, log, hip));
}

#[test]
fn node_with_an_unusable_list_does_not_start() {
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let list = directory.join("access.toml");
    write(&list, "[[rule]]\nfrom = ['*']\n");
    let node = loopback.node("knee").configure(|config| config.security.access = Some(list.clone()));
    let why = node.start().expect_err("nobody is meant").to_string();
    assert!(why.contains("access.toml") && why.contains("rule.to (") && why.contains("line 1"), "{why}");
    // A list that others can write to, and one that is not a file, which would block the start forever.
    write(&list, OPEN);
    std::fs::set_permissions(&list, std::fs::Permissions::from_mode(0o666)).expect("the test's own file");
    for wrong in ["chmod go-w", "no file"] {
        let node = loopback.node("knee").configure(|config| config.security.access = Some(list.clone()));
        let why = node.start().expect_err("it is not taken").to_string();
        assert!(why.contains("access.toml") && why.contains(wrong), "{why}");
        std::fs::remove_file(&list).expect("the test's own file");
        let mode = rustix::fs::Mode::from_raw_mode(0o600);
        rustix::fs::mknodat(rustix::fs::CWD, &list, rustix::fs::FileType::Fifo, mode, 0).expect("a pipe");
    }
    // A list that others could replace.
    std::fs::remove_file(&list).expect("the test's own file");
    write(&list, OPEN);
    let common = directory.join("common");
    std::fs::create_dir(&common).expect("the test's own directory");
    std::fs::set_permissions(&common, std::fs::Permissions::from_mode(0o1777)).expect("the test's own");
    let (there, link) = (common.join("access.toml"), directory.join("link.toml"));
    write(&there, OPEN);
    std::os::unix::fs::symlink(&there, &link).expect("the test's own directory");
    for list in [there, link] {
        let node = loopback.node("knee").configure(|config| config.security.access = Some(list.clone()));
        let why = node.start().expect_err("it is not taken").to_string();
        assert!(why.contains("others can write to") && why.contains("common"), "{why}");
    }
    let open = loopback.node("knee").start().expect("a node");
    assert!(matches!(open.handle().reload_access(), Err(AccessError::None)));
}
