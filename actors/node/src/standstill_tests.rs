//! Layers that read nothing for a while, and their knowledge of applications afterwards.

use std::{collections::BTreeSet, sync::Arc};

use futures_util::{FutureExt, StreamExt};
use sinew_lncl::{LocalApp, app_down, app_ready, app_stopped, register_local, unregister_local};
use sinew_model::{
    config::NodeConfig,
    facts::{AppFact, LinkFact, NodeEvent},
};
use sinew_runtime::{
    app::RequirementEvent,
    lock,
    mailbox::Mailbox,
    pending::{AppSink, Pending},
    tid::{AppAddress, Incarnation},
    time::Time,
    wire::Payload,
};

use super::NodeState;

/// Applications of the node at most.
const APPS_MAX: usize = 64;

/// How far one is that comes, fails and goes by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Is {
    Gone,
    Down(AppAddress),
    Ready(AppAddress),
}

/// A node with layers that read only on the test's request.
struct Standstill {
    state: Arc<NodeState>,
    core: sinew_sync::Core,
    /// The applications that NDL considers ready.
    audience: BTreeSet<AppAddress>,
    notified: Vec<(AppAddress, RequirementEvent)>,
}

impl Standstill {
    fn new() -> Self {
        let mut config = NodeConfig::new("test");
        config.lncl.apps_max = APPS_MAX;
        let core = sinew_sync::Core::new(&config, config.node_address(), Incarnation(1));
        let state = NodeState::for_test(config, Incarnation(1));
        Self { state, core, audience: BTreeSet::new(), notified: Vec::new() }
    }

    fn registers(&self, name: &str, requires: &[&str]) -> AppAddress {
        let app = LocalApp {
            name: Some(name.to_owned()),
            address: None,
            requires: requires.iter().map(|name| (*name).to_owned()).collect(),
            kinds: vec![],
            sink: Arc::new(AppSink { pending: Pending::new(1), inbox: Mailbox::new(1) }),
            events: Arc::new([NodeEvent::KIND]),
        };
        register_local(&self.state.lncl, app).expect("nothing is in the way").app
    }

    /// One that is there changes somehow.
    fn turns(&self, name: &str, is: Is, chance: u64) -> Is {
        match (is, chance % 3) {
            (Is::Gone, _) => Is::Down(self.registers(name, &[])),
            (Is::Down(app), 0 | 1) => {
                app_ready(&self.state.lncl, app);
                Is::Ready(app)
            }
            (Is::Ready(app), 0) => {
                app_down(&self.state.lncl, app);
                Is::Down(app)
            }
            (Is::Ready(app), 1) => {
                app_stopped(&self.state.lncl, app);
                Is::Down(app)
            }
            (Is::Down(app) | Is::Ready(app), _) => {
                unregister_local(&self.state.lncl, app);
                Is::Gone
            }
        }
    }

    /// Both layers read on, as their shells do, until nothing is left.
    fn read_all(&mut self) {
        let mut events = self.state.ctx.event_queues.sync.attach();
        while let Some(event) = events.next().now_or_never().flatten() {
            if let sinew_sync::Event::App(fact) = event {
                self.core.handle(Time::ZERO, sinew_sync::Input::AppChanged(fact));
            }
            while let Some(output) = self.core.poll() {
                if let sinew_sync::Output::Notify { app, event, .. } = output {
                    self.notified.push((app, event));
                }
            }
            self.state.ctx.app_backlogs.offer_to_sync(&self.state.ctx.event_queues);
        }
        let mut events = self.state.ctx.event_queues.ndl.attach();
        while let Some(event) = events.next().now_or_never().flatten() {
            match event {
                sinew_ndl::Event::App(AppFact::Ready { app }) => {
                    self.audience.insert(app);
                }
                sinew_ndl::Event::App(
                    AppFact::Down { app } | AppFact::Stopped { app } | AppFact::Unregistered { app },
                ) => {
                    self.audience.remove(&app);
                }
                sinew_ndl::Event::App(_) | sinew_ndl::Event::Link(_) => {}
            }
            self.state.ctx.app_backlogs.offer_to_ndl(&self.state.ctx.event_queues);
        }
    }

    fn fill_posts(&self) {
        let fact = LinkFact::LinkUp { node: self.state.ctx.node, incarnation: Incarnation(1) };
        while self.state.ctx.event_queues.sync.post(sinew_sync::Event::Monitors).is_ok() {}
        while self.state.ctx.event_queues.ndl.post(sinew_ndl::Event::Link(fact.clone())).is_ok() {}
    }
}

#[test]
fn stalled_layers_learn_the_final_state_of_each_application() {
    for posts_are_full in [true, false] {
        // given: gait runs with its sensor and its drive, and both layers know
        let mut node = Standstill::new();
        let gait = node.registers("gait", &["sensor", "drive"]);
        let (sensor, drive) = (node.registers("sensor", &[]), node.registers("drive", &[]));
        [sensor, drive, gait].into_iter().for_each(|app| app_ready(&node.state.lncl, app));
        node.read_all();
        assert_eq!((node.notified.len(), node.audience.len()), (0, 3));
        // when: both stand still, the sensor fails and is back, the drive goes and comes elsewhere, and
        // others come and go without end
        if posts_are_full {
            node.fill_posts();
        }
        let names: Vec<_> = (0..APPS_MAX - 4).map(|index| format!("app-{index}")).collect();
        let mut apps = vec![Is::Gone; names.len()];
        let (mut chance, mut most, mut new_drive) = (7_u64, 0, drive);
        for turn in 0..40_000 {
            match turn {
                20_000 => app_down(&node.state.lncl, sensor),
                20_001 => app_ready(&node.state.lncl, sensor),
                30_000 => unregister_local(&node.state.lncl, drive),
                30_001 => new_drive = node.registers("drive", &[]),
                30_002 => app_ready(&node.state.lncl, new_drive),
                _ => {}
            }
            chance = chance.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let at = usize::try_from(chance >> 33).unwrap() % names.len();
            apps[at] = node.turns(&names[at], apps[at], chance >> 20);
            most = most.max(node.state.ctx.app_backlogs.most());
        }
        // and read on
        node.read_all();
        // then: their knowledge is true
        let mut ready: Vec<_> =
            apps.iter().filter_map(|is| if let Is::Ready(app) = is { Some(*app) } else { None }).collect();
        ready.extend([gait, sensor, new_drive]);
        ready.sort_unstable();
        assert_eq!(node.audience.iter().copied().collect::<Vec<_>>(), ready);
        let (known, more) = node.core.own_apps(Time::ZERO, usize::MAX);
        let known_ready: Vec<_> = known.iter().filter(|app| app.ready).map(|app| app.app).collect();
        assert_eq!((known_ready, more), (ready, 0));
        let names_of = |app: AppAddress| lock(&node.state.lncl.registry).name_of(app);
        assert!(known.iter().all(|app| app.name.as_deref() == Some(&*names_of(app.app))));
        assert_eq!(known.len(), lock(&node.state.lncl.registry).len());
        // and gait was notified of both ends
        let lost = |name: &str| (gait, RequirementEvent::Lost { name: name.to_owned() });
        let met = |name: &str| (gait, RequirementEvent::Met { name: name.to_owned() });
        assert_eq!(node.notified, [lost("sensor"), met("sensor"), lost("drive"), met("drive")]);
        // and no more waited than there may be applications
        assert!(most > 0 && most <= 5 * APPS_MAX, "{most}");
        assert_eq!(node.state.ctx.app_backlogs.most(), 0);
    }
}
