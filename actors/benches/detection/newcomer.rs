//! The start of a node: the time until the applications of all other nodes are notified of it.

use std::{
    net::{Ipv4Addr, SocketAddrV4, UdpSocket},
    sync::mpsc::{Receiver, sync_channel},
    thread,
    time::Duration,
};

use fastrand::Rng;
use rustix::process::Signal;
use sinew::{
    Time,
    events::{LossReason, NodeEvent},
};
use sinew_figures::{
    Alone, Figures,
    process::{self, Process},
};
use sinew_testkit::Hosts;
use socket2::{Domain, Protocol, Socket, Type};

use crate::{
    nodes::At,
    observer::{DEADLINE, Observer, Told},
    setting::Setting,
    trials::SETTLED,
};

/// Which of the hosts is the newcomer's; the others have a node each.
const NEWCOMER: usize = 0;
const OTHERS: u8 = 3;
/// Bound on the notification of all nodes, if the first announcement arrives.
const AT_ONCE: Duration = Duration::from_millis(20);

/// Maximum number of announcements that wait to be checked; a trial has some dozens at most.
const ANNOUNCED_MAX: usize = 1_024;

/// The fate of the first announcement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum First {
    /// It gets through.
    Heard,
    /// The network drops it, and carries packets after the node has started.
    Lost,
}

impl First {
    pub(crate) const ALL: [Self; 2] = [Self::Heard, Self::Lost];

    /// The name as part of the names of cases.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Heard => "new",
            Self::Lost => "new_unheard",
        }
    }

    fn bound(self, setting: Setting) -> Duration {
        match self {
            Self::Heard => AT_ONCE,
            Self::Lost => setting.asked_every(),
        }
    }
}

/// The results of all trials.
#[derive(Default)]
struct Seen {
    from_start: Figures,
    from_first: Figures,
    in_time: u64,
    surprises: u64,
}

/// The newcomer's host, and the others' nodes.
struct Scene<'a> {
    case: &'a str,
    first: First,
    setting: Setting,
    hosts: Hosts,
    at: At,
    observers: Vec<Observer>,
    /// Arrival times of the newcomer's multicast announcements at the first of the other hosts.
    announced: Receiver<Time>,
    chance: Rng,
    seen: Seen,
}

/// Creates the hosts, and starts a newcomer `trials` times; reports the reason if that is not possible.
/// Returns whether all completed trials went well.
pub(crate) fn measure(case: &str, (first, setting): (First, Setting), trials: u32, seed: u64) -> bool {
    let hosts = match Hosts::new(OTHERS + 1) {
        Ok(hosts) => hosts,
        Err(why) => {
            eprintln!("{case}: skipped: no hosts can be made here: {why}");
            return true;
        }
    };
    let at = At::loopback();
    let others = hosts.all().iter().enumerate().filter(|(index, _)| *index != NEWCOMER);
    let observers: Vec<_> =
        others.map(|(_, host)| host.run(|| Observer::start(setting, at.on(host.address)))).collect();
    for observer in &observers {
        for _ in 1..OTHERS {
            let told = observer.next("another observer");
            assert!(matches!(told.event, NodeEvent::NodeFound { .. }), "found first: {told:?}");
        }
    }
    let (chance, seen) = (Rng::with_seed(seed), Seen::default());
    let announced = listen(&hosts, at);
    let mut scene = Scene { case, first, setting, hosts, at, observers, announced, chance, seen };
    (1..=trials).for_each(|trial| scene.trial(trial));
    scene.report(seed);
    true
}

impl Scene<'_> {
    fn trial(&mut self, trial: u32) {
        thread::sleep(SETTLED + self.setting.asked_every().mul_f64(self.chance.f64()));
        let rest: Vec<_> = self.observers.iter().flat_map(Observer::rest).collect();
        rest.iter().for_each(|event| self.surprise(trial, event));
        self.announced.try_iter().for_each(drop);
        let (newcomer, began) = self.start();
        let is_there = |event: &NodeEvent| {
            matches!(event, NodeEvent::NodeFound { .. } | NodeEvent::NodeRestarted { .. })
        };
        let told = (0..self.observers.len()).map(|other| self.await_event(trial, other, is_there));
        let last = told.max().expect("there are observers");
        let first = match self.first {
            First::Heard => self.announced.recv_timeout(DEADLINE).expect("who is found has announced itself"),
            First::Lost => began,
        };
        let after = last.since(first);
        self.seen.from_start.record(last.since(began));
        self.seen.from_first.record(after);
        self.seen.in_time += u64::from(after <= self.first.bound(self.setting));
        self.leave(newcomer, trial);
    }

    /// Starts its process. Returns when its node was started, or when the network carried its packets.
    fn start(&self) -> (Process, Time) {
        let host = &self.hosts.all()[NEWCOMER];
        let role = format!("subject any {} {}", self.setting.name(), self.at.on(host.address));
        if self.first == First::Lost {
            self.hosts.swallow(NEWCOMER);
        }
        let mut newcomer = Process::start_command(host.moved(&process::command(&role)), &role);
        let began = newcomer.line().parse().map(Time::from_nanos);
        let mut began = began.expect("the subject says when it began to start its node");
        if self.first == First::Lost {
            began = Time::now();
            self.hosts.carry(NEWCOMER);
        }
        (newcomer, began)
    }

    /// Stops the newcomer in order, so that it is unknown at the next start.
    fn leave(&mut self, newcomer: Process, trial: u32) {
        newcomer.signal(Signal::TERM);
        let has_left = |event: &NodeEvent| matches!(event, NodeEvent::NodeLost { why: LossReason::Left, .. });
        for other in 0..self.observers.len() {
            self.await_event(trial, other, has_left);
        }
        // Its remaining events are not needed.
        let _ = newcomer.wait();
    }

    /// Returns the time of this observer's event; earlier events count as surprises.
    fn await_event(&mut self, trial: u32, observer: usize, is_it: impl Fn(&NodeEvent) -> bool) -> Time {
        loop {
            let Told { at, event, .. } =
                self.observers[observer].next(&format!("{}: trial {trial}", self.case));
            if is_it(&event) {
                return at;
            }
            self.surprise(trial, &event);
        }
    }

    fn surprise(&mut self, trial: u32, event: &NodeEvent) {
        self.seen.surprises += 1;
        eprintln!("{}: trial {trial}: a surprise: {event:?}", self.case);
    }

    fn report(&self, seed: u64) {
        let (case, bound) = (self.case, self.first.bound(self.setting));
        let bound_us = u64::try_from(bound.as_micros()).expect("some milliseconds");
        let counts = [
            ("bound_us", bound_us),
            ("in_time", self.seen.in_time),
            ("others", OTHERS.into()),
            ("surprises", self.seen.surprises),
            ("seed", seed),
        ];
        let alone = |figure, seen, counts| Alone { bench: "detection", case, figure, seen, counts }.report();
        if self.first == First::Heard {
            alone("first announcement to all told", &self.seen.from_first, &counts);
            alone("start of the node to all told", &self.seen.from_start, &[]);
        } else {
            alone("packets carried to all told", &self.seen.from_first, &counts);
        }
    }
}

/// Listens to the multicast group on the first of the other hosts, and reports the time of each announcement
/// of the newcomer.
fn listen(hosts: &Hosts, at: At) -> Receiver<Time> {
    let words = at.to_string();
    let group = words.split_once('@').and_then(|(_, group)| group.parse().ok());
    let group: SocketAddrV4 = group.expect("an address and a group");
    let (newcomer, here) = (hosts.all()[NEWCOMER].address, &hosts.all()[NEWCOMER + 1]);
    let socket = here.run(|| join(group, here.address)).expect("a socket in the group");
    let (tell, announced) = sync_channel(ANNOUNCED_MAX);
    thread::spawn(move || {
        while let Ok((_, from)) = socket.recv_from(&mut [0; 2_048]) {
            if from.ip() == newcomer {
                // Those that find no room are not the first of a trial.
                let _ = tell.try_send(Time::now());
            }
        }
    });
    announced
}

fn join(group: SocketAddrV4, interface: Ipv4Addr) -> std::io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    // The node of that host listens to the group, too.
    socket.set_reuse_address(true)?;
    socket.bind(&group.into())?;
    socket.join_multicast_v4(group.ip(), &interface)?;
    Ok(socket.into())
}
