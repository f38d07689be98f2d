//! Both nodes with the faulty network between them, as their director sees them.

use std::{
    net::{Ipv4Addr, SocketAddr},
    num::NonZeroU32,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew::{
    Class,
    audit::{Audit, Place},
};

use super::{
    CLASSES, Plan,
    node::wall_seconds,
    pacer::share,
    progress::{self, Progress},
    report::Gap,
    trouble::Trouble,
    wall_clock::{self, JUMP, WallClock},
};
use crate::{
    DEADLINE, OwnDirectory,
    clients::Performer,
    history::{Fault, History, Party, Station, Verdict},
    preload::Preload,
    proxy::{Counts, Cut, Door, Proxy, Side},
    unique, until,
};

/// The one that sends most.
const FIRST: Station = 1;
/// The other.
const SECOND: Station = 2;

/// The doors: to the second node's GNCL, to the first's, to the second's NDL, and to both GNCLs' datagrams at the places of the first two.
const TO_SECOND: usize = 0;
const TO_FIRST: usize = 1;
const TO_SECOND_UDP: usize = 2;
const TO_SECOND_STREAM: usize = 3;
const TO_FIRST_STREAM: usize = 4;
/// Longest wait for what lies behind a full queue that is carried piece by piece.
const BACKLOG_WITHIN: Duration = DEADLINE.saturating_mul(10);
/// Between two looks at how far the messages are.
const LOOK: Duration = Duration::from_millis(1);
/// Where GNCL is reached, at an address that only this has.
const PORT: u16 = 6_912;

type Shared = Arc<Mutex<History>>;

fn lock(history: &Shared) -> MutexGuard<'_, History> {
    history.lock().unwrap_or_else(PoisonError::into_inner)
}

/// One of the nodes, in the life that it is in.
struct Member {
    station: Station,
    life: u32,
    interface: Ipv4Addr,
    performer: Performer,
    /// Where it has one of its own.
    clock: Option<WallClock>,
    answers: Receiver<String>,
}

pub(super) struct Pair {
    plan: Plan,
    proxy: Proxy,
    history: Shared,
    members: [Member; 2],
    directory: OwnDirectory,
    /// Where wall clocks are to be set.
    clocks: Option<Preload>,
    progress: Progress,
}

impl Pair {
    /// Starts the nodes, and lets messages flow.
    pub(super) fn start(plan: &Plan) -> Self {
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        let [second, first] = [(); 2].map(|()| SocketAddr::from((own_interface(), PORT)));
        let door = |side, listen, datagrams| Door { side, listen, datagrams };
        let doors = [
            door(Side::Right, second, false),
            door(Side::Left, first, false),
            door(Side::Right, listen, true),
            door(Side::Right, second, true),
            door(Side::Left, first, true),
        ];
        let proxy = Proxy::start(&doors, plan.seed).expect("ports on loopback");
        for side in [Side::Left, Side::Right] {
            proxy.change(side, |faults| {
                faults.one_flip_in = plan.one_flip_in.and_then(NonZeroU32::new);
            });
        }
        let (history, directory) = (Shared::default(), OwnDirectory::new());
        let sets_clocks =
            plan.troubles.iter().any(|one| matches!(one, Trouble::ClockOn | Trouble::ClockBack));
        let clocks = sets_clocks.then(|| wall_clock::library(&directory.join("")));
        let members = [FIRST, SECOND].map(|station| {
            let interface = own_interface();
            start((station, 1), interface, (plan, &proxy), (&history, &directory, clocks.as_ref()))
        });
        let progress = Progress::begin(plan.faults);
        let mut pair = Self { plan: plan.clone(), proxy, history, members, directory, clocks, progress };
        [FIRST, SECOND].into_iter().for_each(|station| pair.begin(station));
        pair.wait_for_flow();
        pair
    }

    fn member(&mut self, station: Station) -> &mut Member {
        &mut self.members[usize::from(station - FIRST)]
    }

    fn party(&self, station: Station) -> Party {
        Party { station, life: self.members[usize::from(station - FIRST)].life }
    }

    /// Messages flow from `station` as soon as it sees the other.
    fn begin(&mut self, station: Station) {
        let rate = if station == FIRST { self.plan.rate } else { self.plan.back_rate };
        self.member(station).performer.tell(&format!("rate {rate}"));
    }

    /// The last number of this class that has come from `from`.
    fn last_got(&self, (from, to, class): (Station, Station, Class)) -> u64 {
        lock(&self.history).last_got(self.party(from), to, class)
    }

    /// Waits until messages that are sent after this come, both ways: those of each class at the second node, whose [gaps](Self::gaps) are
    /// over then.
    ///
    /// What is sent is written down a little later: what was under way then is less than what this waits for.
    pub(super) fn wait_for_flow(&mut self) {
        let there = CLASSES.map(|class| (FIRST, SECOND, class));
        for way @ (from, to, class) in there.into_iter().chain([(SECOND, FIRST, Class::Bulk)]) {
            let rate = if from == FIRST { self.plan.rate } else { self.plan.back_rate };
            if rate > 0 {
                let party = self.party(from);
                let under_way = (rate as f64 * share(class) / 200.0) as u64;
                let upto = lock(&self.history).last_sent(party, to, class) + under_way + 1;
                self.wait_to_get(upto, way);
            }
        }
    }

    /// Waits until this number has come, for as long as any come: where connections end faster than they carry what is sent, as with many
    /// flipped bits on a busy host, a full queue lies before it.
    fn wait_to_get(&mut self, upto: u64, way: (Station, Station, Class)) {
        let (began, (from, to, class)) = (Instant::now(), way);
        let (mut got, mut since, mut network) = (self.last_got(way), began, self.proxy.counts());
        while got < upto {
            let now = self.last_got(way);
            if now > got {
                (got, since, network) = (now, Instant::now(), self.proxy.counts());
            }
            assert!(
                since.elapsed() < DEADLINE && began.elapsed() < BACKLOG_WITHIN,
                "{class:?} from {from} to {to}, {got} was got {:?} ago, and {upto} is waited for since {:?}; the network then and now:\n{network:?}\n{:?}",
                since.elapsed(),
                began.elapsed(),
                self.proxy.counts()
            );
            if self.progress.is_due(Instant::now()) {
                self.say_progress(&format!(
                    "number {upto} of {class:?} from {from} to {to}, since {:?}",
                    began.elapsed()
                ));
            }
            std::thread::sleep(LOOK);
        }
    }

    /// The next fault strikes.
    pub(super) fn strikes(&mut self, trouble: Trouble) {
        self.progress.strikes(trouble);
    }

    /// Says how far the run is. Both nodes are asked, so nothing else may be that they have not answered.
    fn say_progress(&mut self, waits_for: &str) {
        let way = |from, to, rate| {
            let (history, party) = (lock(&self.history), self.party(from));
            let class = Class::Bulk;
            let (sent, got) = (history.last_sent(party, to, class), history.last_got(party, to, class));
            progress::Way { sent, got, rate }
        };
        let ways = [way(FIRST, SECOND, self.plan.rate), way(SECOND, FIRST, self.plan.back_rate)];
        let queues = [FIRST, SECOND].map(|station| (station, self.member(station).ask("queues")));
        eprintln!("{}", self.progress.say(Instant::now(), ways, waits_for, &queues));
    }

    /// The longest times without a message at the second node since this was asked last, or since it was started.
    pub(super) fn gaps(&mut self) -> Gap {
        let nanos = self.member(SECOND).ask("gap");
        let gaps: Vec<_> = nanos.split_whitespace().map(|nanos| nanos.parse().expect("a number")).collect();
        let [all, each @ ..] = <[u64; 4]>::try_from(gaps).expect("one of all, and one of each class");
        Gap { all: Duration::from_nanos(all), each: each.map(Duration::from_nanos) }
    }

    /// Something happens. Returns when it is over.
    pub(super) fn suffer(&mut self, trouble: Trouble, hold: Duration) {
        match trouble {
            Trouble::Cut => self.cut(Cut::Reset),
            Trouble::Finish => self.cut(Cut::Finish),
            Trouble::PanicSender => drop(self.member(FIRST).ask_as("panic", "ready")),
            Trouble::PanicReceiver => drop(self.member(SECOND).ask_as("panic", "ready")),
            Trouble::Stall => self.hold(&[Side::Left, Side::Right], hold, |faults| faults.stalled = true),
            Trouble::PartThere => self.hold(&[Side::Right], hold, |faults| faults.parted = true),
            Trouble::PartBack => self.hold(&[Side::Left], hold, |faults| faults.parted = true),
            Trouble::Freeze => {
                self.member(SECOND).performer.freeze();
                std::thread::sleep(hold);
                self.member(SECOND).performer.signal(Signal::CONT);
            }
            Trouble::KillReceiver => self.replace(SECOND),
            Trouble::KillSender => self.replace(FIRST),
            Trouble::ClockOn => self.set_clocks(JUMP),
            Trouble::ClockBack => self.set_clocks(-JUMP),
        }
    }

    /// The wall clocks of both nodes jump, and both see it.
    fn set_clocks(&mut self, jump: i64) {
        for member in &mut self.members {
            let clock = member.clock.as_mut().expect("it was made where clocks are to be set");
            clock.jump(jump);
            let right = wall_seconds().checked_add_signed(clock.off_by).expect("a day after 1970");
            let seen: u64 = member.ask("wall").parse().expect("a number");
            assert!(
                seen.abs_diff(right) <= DEADLINE.as_secs(),
                "the clock says {seen} s, and was set to {right}"
            );
        }
    }

    fn cut(&self, how: Cut) {
        // One that is being made at this moment is not there yet.
        until("there is a connection", || (self.proxy.counts().open > 0).then_some(()));
        let before = self.proxy.counts();
        self.proxy.cut(how);
        until("it is cut", || {
            let now = self.proxy.counts();
            (now.cut > before.cut || now.made > before.made).then_some(())
        });
    }

    fn hold(&self, sides: &[Side], hold: Duration, change: impl Fn(&mut crate::proxy::Faults)) {
        sides.iter().for_each(|side| self.proxy.change(*side, &change));
        std::thread::sleep(hold);
        for side in sides {
            self.proxy.change(*side, |faults| (faults.stalled, faults.parted) = (false, false));
        }
    }

    /// Kills a node, and starts its next life. As on a host of its own, nobody listens in between.
    fn replace(&mut self, station: Station) {
        let party = self.party(station);
        self.proxy.refuse(true);
        self.member(station).performer.kill_now();
        lock(&self.history).killed(party);
        let interface = self.member(station).interface;
        let next = start(
            (station, party.life + 1),
            interface,
            (&self.plan, &self.proxy),
            (&self.history, &self.directory, self.clocks.as_ref()),
        );
        *self.member(station) = next;
        self.proxy.refuse(false);
        self.begin(station);
    }

    /// No more is sent; waits until what was sent has arrived, and says what became of everything.
    pub(super) fn finish(mut self) -> (Verdict, Counts, Audit) {
        for side in [Side::Left, Side::Right] {
            self.proxy.change(side, |faults| faults.one_flip_in = None);
        }
        self.members.iter_mut().for_each(|member| member.performer.tell("quiet"));
        self.members.iter_mut().for_each(|member| drop(member.wait_for("quiet")));
        let end = Instant::now() + DEADLINE;
        let mut verdict = lock(&self.history).verdict();
        // What is on its way counts as lost as long as it is.
        while verdict.count(Fault::Lost) > 0 && Instant::now() < end {
            self.members.iter_mut().for_each(|member| member.performer.tell("say"));
            std::thread::sleep(Duration::from_millis(100));
            verdict = lock(&self.history).verdict();
        }
        let audit = self.audit_once_quiet();
        let network = self.proxy.counts();
        for member in self.members {
            let status = member.performer.end();
            assert!(status.success(), "node {} ended with {status}", member.station);
        }
        (verdict, network, audit)
    }

    /// What both nodes say of all messages, once none waits but perhaps the audit's own question and answer, which are Bulk, and no value is
    /// under way: one that went by datagram, and whose place a newer one took, is so until its time is over.
    fn audit_once_quiet(&mut self) -> Audit {
        const OWN: u64 = 2;
        let first = self.member(FIRST);
        let end = Instant::now() + DEADLINE;
        loop {
            let audit: Audit = serde_json::from_str(&first.ask("audit")).expect("an audit");
            let values = audit
                .nodes
                .iter()
                .flat_map(|node| &node.entries)
                .filter(|entry| matches!(entry.place, Place::ToNode { class: Some(Class::Stream), .. }));
            let values: u64 = values.map(|entry| entry.account.unacknowledged).sum();
            if audit.nodes.len() == 2 && audit.total().waiting <= OWN && values == 0 {
                return audit;
            }
            assert!(
                Instant::now() < end,
                "for {DEADLINE:?} not both nodes answer, or messages wait or are under way:\n{audit}"
            );
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// A loopback address that no other test of this host has at the same time, but for one whose process's id is 4,096 further, or a multiple of that.
fn own_interface() -> Ipv4Addr {
    let [_, b, c, d] = unique().to_be_bytes();
    // Any of them is a host's: the network's ends are not among these.
    Ipv4Addr::new(127, 64 | b & 63, c, d)
}

fn start(
    (station, life): (Station, u32),
    interface: Ipv4Addr,
    (plan, proxy): (&Plan, &Proxy),
    (history, directory, clocks): (&Shared, &OwnDirectory, Option<&Preload>),
) -> Member {
    let (announce, seeds) = if station == FIRST {
        (proxy.address(TO_FIRST), format!("[\"{}\"]", proxy.address(TO_SECOND_UDP)))
    } else {
        (proxy.address(TO_SECOND), "[]".to_owned())
    };
    let text = format!(
        "[node]\nname = \"node-{station}\"\nproject = \"link faults\"\nmailbox_capacity = 65536\n\
         [gncl]\nannounce = \"{announce}\"\nqueue_capacity = 65536\n\
         [ndl]\ninterface = \"{interface}\"\nmulticast = false\nmdns_port = false\nseeds = {seeds}\n\
         [supervision]\nlayer_restarts_max = 1000000\nlayer_window_ms = 10\n"
    );
    let path = directory.join(&format!("node-{station}.toml"));
    std::fs::write(&path, text).expect("the scenario's own directory");
    let arguments =
        [u64::from(station), life.into(), u64::from(FIRST + SECOND - station), plan.filling as u64];
    let arguments: Vec<String> =
        [path.display().to_string()].into_iter().chain(arguments.map(|number| number.to_string())).collect();
    let (say, answers) = sync_channel(64);
    let (party, notes) = (Party { station, life }, history.clone());
    let hear = move |line: &str| hear(party, &notes, &say, line);
    // A new life's clock is right again.
    let clock = clocks.map(|library| WallClock::new(library, &format!("clock-{station}-{life}")));
    let environment: Vec<_> = clock.iter().flat_map(WallClock::environment).collect();
    let performer = Performer::start_with(&plan.program, "node", &arguments, &environment, hear);
    let member = Member { station, life, interface, performer, clock, answers };
    let places = member.wait_for("up");
    let places: Vec<SocketAddr> =
        places.split_whitespace().map(|place| place.parse().expect("an address")).collect();
    if station == FIRST {
        proxy.lead(TO_FIRST, places[0]);
        // The same port, as nobody else has this address.
        proxy.lead(TO_FIRST_STREAM, places[0]);
    } else {
        proxy.lead(TO_SECOND, places[0]);
        proxy.lead(TO_SECOND_STREAM, places[0]);
        proxy.lead(TO_SECOND_UDP, places[1]);
    }
    member
}

fn hear(party: Party, history: &Shared, say: &SyncSender<String>, line: &str) {
    match line.parse() {
        Ok(note) => lock(history).note(party, note),
        // Nobody waits for its answers any more when the director is done.
        Err(_) => drop(say.send(line.to_owned())),
    }
}

impl Member {
    fn wait_for(&self, word: &str) -> String {
        let answer = self.answers.recv_timeout(DEADLINE);
        let answer = answer.unwrap_or_else(|_| panic!("node {} does not say {word:?}", self.station));
        let rest = answer.strip_prefix(word);
        rest.unwrap_or_else(|| panic!("{answer:?} instead of {word:?}")).trim().to_owned()
    }

    fn ask(&mut self, question: &str) -> String {
        self.ask_as(question, question)
    }

    fn ask_as(&mut self, question: &str, answer: &str) -> String {
        self.performer.tell(question);
        self.wait_for(answer)
    }
}
