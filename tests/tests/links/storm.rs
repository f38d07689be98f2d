//! A node whose port is stormed: thousands of connections that say nothing, and no descriptors left, while peers are served.

use std::{
    collections::VecDeque,
    net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener, TcpStream},
    path::{Path, PathBuf},
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew_tests::{DEADLINE, OwnDirectory, Program, node_under_test, own_group, program};

/// Descriptors of the stormed node: some 40 are its own.
const DESCRIPTORS: &str = "96";
/// Connections that each of the storm's threads holds at once.
const HELD: usize = 400;
const THREADS: usize = 4;
/// Connections that were made before it counts as a storm.
const MANY: usize = 4_000;

/// Connects and says nothing, again and again, until it is dropped.
struct Storm {
    made: Arc<AtomicUsize>,
    is_over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Storm {
    fn on(target: SocketAddr) -> Self {
        let (made, is_over) = (Arc::<AtomicUsize>::default(), Arc::<AtomicBool>::default());
        let threads = (0..THREADS).map(|_| {
            let (made, is_over) = (made.clone(), is_over.clone());
            std::thread::spawn(move || {
                let mut held = VecDeque::new();
                while !is_over.load(Ordering::Relaxed) {
                    // Where the queue of those that wait is full, the system takes no more for a while.
                    if let Ok(silent) = TcpStream::connect_timeout(&target, Duration::from_millis(100)) {
                        made.fetch_add(1, Ordering::Relaxed);
                        held.push_back(silent);
                    }
                    if held.len() > HELD {
                        held.pop_front();
                    }
                    std::thread::sleep(Duration::from_micros(500));
                }
            })
        });
        Self { threads: threads.collect(), made, is_over }
    }

    fn wait(&self) {
        let (until, before) = (Instant::now() + 3 * DEADLINE, self.made.load(Ordering::Relaxed));
        while self.made.load(Ordering::Relaxed) < before + MANY {
            assert!(Instant::now() < until, "{} connections are no storm", self.made.load(Ordering::Relaxed));
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

impl Drop for Storm {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A panic there is not this thread's to repeat.
            let _ = thread.join();
        }
    }
}

fn configuration(
    directory: &OwnDirectory,
    group: SocketAddrV4,
    (name, address): (&str, u8),
    gncl: &str,
) -> PathBuf {
    let path = directory.join(&format!("{name}.toml"));
    let text = format!(
        "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"storm\"\n[gncl]\n{gncl}\n\
         [ndl]\nmulticast = \"{group}\"\nmdns_port = false\nmissed_max = 20\n"
    );
    std::fs::write(&path, text).expect("the test's own directory");
    path
}

/// A port that is free now.
fn free_port() -> u16 {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("loopback has a free port");
    listener.local_addr().expect("it is bound").port()
}

/// A node that has few descriptors, however many its limit would allow.
fn starved_node(configuration: &Path) -> Program {
    let mut command = Command::new("sh");
    command.args(["-c", r#"ulimit -n $0 && exec "$@""#, DESCRIPTORS]).arg(program("node_under_test"));
    command.arg(configuration);
    Program::start("knee", command)
}

#[test]
fn a_peer_is_served_and_a_new_one_taken_while_thousands_say_nothing_and_no_descriptors_are_left() {
    let (directory, group, port) = (OwnDirectory::new(), own_group(), free_port());
    let write = |name, address, gncl: &str| configuration(&directory, group, (name, address), gncl);
    // So many strangers are allowed that the descriptors run out first.
    let gncl = format!("port = {port}\nstrangers_max = 1024\nhandshake_ms = 60000");
    let (knee, hip) = (write("knee", 2, &gncl), write("hip", 1, ""));
    let mut knee = starved_node(&knee);
    knee.wait_for(&["up"]);
    let sends = ["--requires", "knee", "--sends-to", "knee"];
    let hip = node_under_test(None, &hip, &sends);
    knee.wait_for(&["count 1 from 127.0.0.1"]);

    let storm = Storm::on((Ipv4Addr::LOCALHOST, port).into());
    storm.wait();
    let mut ankle = node_under_test(None, &write("ankle", 3, ""), &sends);
    ankle.wait_for(&["started"]);
    knee.wait_for(&["count 1 from 127.0.0.3"]);
    storm.wait();
    // Each with a deadline of its own: how many a second come is the machine's affair.
    for count in [250, 500, 750, 1_000] {
        knee.wait_for(&[&format!("count {count} from 127.0.0.3")]);
    }
    assert!(knee.said().iter().all(|line| !line.contains("NodeLost")), "nobody was lost meanwhile");
    hip.signal(Signal::TERM);
    knee.wait_for(&["NodeLost", "hip", "Left"]);
}
