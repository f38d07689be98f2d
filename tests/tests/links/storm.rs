//! A node under a connection flood: thousands of silent connections and no free descriptors, while peers are
//! served.

use sinew_testkit::sandbox::after_shell;
use sinew_tests::role;
use std::{
    collections::VecDeque,
    net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener, TcpStream},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew_testkit::{DEADLINE, NodeProcess, TestDirectory, own_group};
use sinew_tests::node_under_test;

/// Descriptor limit of the flooded node: it uses about 40 itself.
const DESCRIPTORS: &str = "96";
/// Connections that each thread of the flood holds at the same time.
const HELD: usize = 400;
const THREADS: usize = 4;
/// Connections that must have been made before it counts as a flood.
const MANY: usize = 4_000;

/// Connects without sending, again and again, until it is dropped.
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
                    // If the accept queue is full, the system accepts no connection for a while.
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
            // A panic of that thread is not repeated here.
            let _ = thread.join();
        }
    }
}

fn configuration(
    directory: &TestDirectory,
    group: SocketAddrV4,
    (name, address): (&str, u8),
    gncl: &str,
) -> PathBuf {
    let text = format!(
        "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"storm\"\n[gncl]\n{gncl}\n\
         [ndl]\nmulticast = \"{group}\"\nmdns_port = false\nmissed_max = 20\n"
    );
    directory.write(&format!("{name}.toml"), &text)
}

/// Returns a port that is free now.
fn free_port() -> u16 {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("loopback has a free port");
    listener.local_addr().expect("it is bound").port()
}

/// A node with few descriptors, even if its hard limit allows more.
fn starved_node(configuration: &Path) -> NodeProcess {
    let mut command = role("node_under_test");
    command.arg(configuration);
    NodeProcess::start("knee", after_shell(&format!("ulimit -n {DESCRIPTORS}"), &command))
}

#[test]
fn peers_are_served_during_a_connection_flood() {
    let (directory, group, port) = (TestDirectory::new(), own_group(), free_port());
    let write = |name, address, gncl: &str| configuration(&directory, group, (name, address), gncl);
    // Enough unauthenticated connections are allowed for the descriptors to run out first.
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
    // Each with a deadline of its own: the rate depends on the machine.
    for count in [250, 500, 750, 1_000] {
        knee.wait_for(&[&format!("count {count} from 127.0.0.3")]);
    }
    assert!(knee.output().iter().all(|line| !line.contains("NodeLost")), "nobody was lost meanwhile");
    hip.signal(Signal::TERM);
    knee.wait_for(&["NodeLost", "hip", "Left"]);
}
