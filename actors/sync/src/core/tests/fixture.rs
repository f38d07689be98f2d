//! A core with its clock, and short forms of its inputs and outputs.

use super::*;

/// A core and its clock.
pub(super) struct Bench {
    pub(super) core: Core,
    pub(super) now: Time,
    /// Reports of names that no application has: the waiting application, the name, and similar ones.
    pub(super) misspelt: Vec<(String, String, Vec<String>)>,
}

impl Bench {
    pub(super) fn new() -> Self {
        let core = Core::new(&NodeConfig::new("hip"), HERE, Incarnation(1));
        Self { core, now: Time::from_nanos(1_000_000_000), misspelt: Vec::new() }
    }

    /// Application 0 is "gait" and requires "sensor", which is application 1; both are ready.
    pub(super) fn where_gait_runs_with_its_sensor() -> Self {
        let mut bench = Self::new();
        bench.registers(0, "gait", &["sensor"]);
        bench.registers(1, "sensor", &[]);
        bench.ready(1);
        bench.ready(0);
        bench
    }

    pub(super) fn handle(&mut self, input: Input) -> Vec<Output> {
        self.core.handle(self.now, input);
        let mut outputs = Vec::new();
        while let Some(output) = self.core.poll() {
            if let Output::Misspelt { application, name, nearest } = output {
                self.misspelt.push((application, name, nearest));
            } else {
                outputs.push(output);
            }
        }
        outputs
    }

    pub(super) fn registers(&mut self, index: u32, name: &str, requires: &[&str]) -> Vec<Output> {
        let requires = requires.iter().map(|name| (*name).to_owned()).collect();
        let name = (!name.is_empty()).then(|| name.to_owned());
        self.handle(Input::AppChanged(AppFact::own_registered(app(index), name, requires)))
    }

    pub(super) fn ready(&mut self, index: u32) -> Vec<Output> {
        self.handle(Input::AppChanged(AppFact::Ready { app: app(index) }))
    }

    pub(super) fn down(&mut self, index: u32) -> Vec<Output> {
        self.handle(Input::AppChanged(AppFact::Down { app: app(index) }))
    }

    pub(super) fn links(&mut self, node: NodeAddress, incarnation: Incarnation) -> Vec<Output> {
        self.handle(Input::LinkChanged(LinkFact::LinkUp { node, incarnation }))
    }

    pub(super) fn breaks(&mut self, node: NodeAddress) -> Vec<Output> {
        self.handle(Input::LinkChanged(LinkFact::LinkBroken { node, incarnation: INCARNATION }))
    }

    pub(super) fn lost(&mut self, node: NodeAddress, why: LossReason) -> Vec<Output> {
        let lost = MembershipFact::NodeLost { node, incarnation: INCARNATION, why };
        self.handle(Input::MembershipChanged(lost))
    }

    pub(super) fn list(&mut self, from: NodeAddress, list: List) -> Vec<Output> {
        self.handle(Input::ListReceived { from, payload: list.encode(usize::MAX).0 })
    }

    pub(super) fn passes(&mut self, time: Duration) -> Vec<Output> {
        self.now = self.now + time;
        self.handle(Input::TimePassed)
    }

    /// Returns the reasons that keep the first waiting application.
    pub(super) fn missing(&self) -> Vec<(String, &'static str)> {
        in_words(self.core.waiting(self.now).remove(0).missing)
    }
}

pub(super) fn app(index: u32) -> AppAddress {
    AppAddress::fixed(index).unwrap()
}

pub(super) fn list(version: u64, entries: &[(&str, bool, &[&str])]) -> List {
    let name = |text: &str| Name::try_from(text.to_owned()).unwrap();
    let entries = (0..).zip(entries).map(|(index, (text, ready, requires))| Entry {
        name: name(text),
        app: app(index),
        ready: *ready,
        ended: None,
        phases: Vec::new(),
        requires: requires.iter().map(|text| text.parse().unwrap()).collect(),
        kinds: Vec::new(),
        handles: Vec::new(),
        sends: Vec::new(),
    });
    List { incarnation: INCARNATION, version, entries: entries.collect(), groups: Vec::new() }
}

pub(super) fn release(index: u32) -> Output {
    Output::Release { app: app(index) }
}

pub(super) fn lost(index: u32, name: &str, why: Reason) -> Output {
    let event = RequirementEvent::Lost { name: name.to_owned() };
    Output::Notify { app: app(index), event, why: Some(why) }
}

pub(super) fn met(index: u32, name: &str) -> Output {
    Output::Notify { app: app(index), event: RequirementEvent::Met { name: name.to_owned() }, why: None }
}

pub(super) fn published(outputs: &[Output]) -> Vec<List> {
    let mut lists = Vec::new();
    for output in outputs {
        if let Output::Publish { list, .. } = output {
            lists.push(List::parse(list).unwrap());
        }
    }
    lists
}
