//! Layers that read nothing for a while, and what they know of applications afterwards.

use std::collections::BTreeSet;

use futures_util::{FutureExt, StreamExt};
use sinew_runtime::{
    app::RequirementEvent,
    mailbox::Mailbox,
    pending::{AppOutlet, Pending},
    tid::Incarnation,
};

use super::*;
use crate::{NodeConfig, gncl::LinkFact, ndl, sync};

/// Applications of the node at most.
const APPS_MAX: usize = 64;

/// How far one is that comes, fails and goes by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Is {
    Gone,
    Down(AppAddress),
    Ready(AppAddress),
}

/// A node whose layers read nothing before the test has them read.
struct Standstill {
    stores: Arc<Stores>,
    core: sync::Core,
    /// What NDL takes for ready.
    audience: BTreeSet<AppAddress>,
    told: Vec<(AppAddress, RequirementEvent)>,
}

impl Standstill {
    fn new() -> Self {
        let mut config = NodeConfig::new("test");
        config.lncl.apps_max = APPS_MAX;
        let core = sync::Core::new(&config, config.node_address(), Incarnation(1));
        let stores = Stores::for_test(config, Incarnation(1));
        Self { stores, core, audience: BTreeSet::new(), told: Vec::new() }
    }

    fn registers(&self, name: &str, requires: &[&str]) -> AppAddress {
        let app = LocalApp {
            name: Some(name.to_owned()),
            address: None,
            requires: requires.iter().map(|name| (*name).to_owned()).collect(),
            kinds: vec![],
            outlet: Arc::new(AppOutlet { pending: Pending::new(1), inbox: Mailbox::new(1) }),
            events: Arc::new([NodeEvent::KIND]),
        };
        register_local(&self.stores, app).expect("nothing is in the way").app
    }

    /// One that is there changes somehow.
    fn turns(&self, name: &str, is: Is, chance: u64) -> Is {
        match (is, chance % 3) {
            (Is::Gone, _) => Is::Down(self.registers(name, &[])),
            (Is::Down(app), 0 | 1) => {
                app_ready(&self.stores, app);
                Is::Ready(app)
            }
            (Is::Ready(app), 0) => {
                app_down(&self.stores, app);
                Is::Down(app)
            }
            (Is::Ready(app), 1) => {
                app_stopped(&self.stores, app);
                Is::Down(app)
            }
            (Is::Down(app) | Is::Ready(app), _) => {
                unregister_local(&self.stores, app);
                Is::Gone
            }
        }
    }

    /// Both layers read on, as their shells do, until nothing is left.
    fn read_all(&mut self) {
        let mut post = self.stores.posts.sync.attach();
        while let Some(event) = post.next().now_or_never().flatten() {
            if let sync::Event::App(fact) = event {
                self.core.handle(Time::ZERO, sync::Input::AppChanged(fact));
            }
            while let Some(output) = self.core.poll() {
                if let sync::Output::Tell { app, event, .. } = output {
                    self.told.push((app, event));
                }
            }
            self.stores.untold_of_apps.offer_to_sync(&self.stores.posts);
        }
        let mut post = self.stores.posts.ndl.attach();
        while let Some(event) = post.next().now_or_never().flatten() {
            match event {
                ndl::Event::App(AppFact::Ready { app }) => {
                    self.audience.insert(app);
                }
                ndl::Event::App(
                    AppFact::Down { app } | AppFact::Stopped { app } | AppFact::Unregistered { app },
                ) => {
                    self.audience.remove(&app);
                }
                ndl::Event::App(_) | ndl::Event::Link(_) => {}
            }
            self.stores.untold_of_apps.offer_to_ndl(&self.stores.posts);
        }
    }

    fn fill_posts(&self) {
        let fact = LinkFact::LinkUp { node: self.stores.node, incarnation: Incarnation(1) };
        while self.stores.posts.sync.post(sync::Event::Monitors).is_ok() {}
        while self.stores.posts.ndl.post(ndl::Event::Link(fact.clone())).is_ok() {}
    }
}

#[test]
fn layers_that_stood_still_while_ten_thousand_applications_changed_know_each_as_it_is_then() {
    for posts_are_full in [true, false] {
        // given: gait runs with its sensor and its drive, and both layers know
        let mut node = Standstill::new();
        let gait = node.registers("gait", &["sensor", "drive"]);
        let (sensor, drive) = (node.registers("sensor", &[]), node.registers("drive", &[]));
        [sensor, drive, gait].into_iter().for_each(|app| app_ready(&node.stores, app));
        node.read_all();
        assert_eq!((node.told.len(), node.audience.len()), (0, 3));
        // when: both stand still, the sensor fails and is back, the drive goes and comes elsewhere, and others come and go without end
        if posts_are_full {
            node.fill_posts();
        }
        let names: Vec<_> = (0..APPS_MAX - 4).map(|index| format!("app-{index}")).collect();
        let mut apps = vec![Is::Gone; names.len()];
        let (mut chance, mut most, mut new_drive) = (7_u64, 0, drive);
        for turn in 0..40_000 {
            match turn {
                20_000 => app_down(&node.stores, sensor),
                20_001 => app_ready(&node.stores, sensor),
                30_000 => unregister_local(&node.stores, drive),
                30_001 => new_drive = node.registers("drive", &[]),
                30_002 => app_ready(&node.stores, new_drive),
                _ => {}
            }
            chance = chance.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let at = usize::try_from(chance >> 33).unwrap() % names.len();
            apps[at] = node.turns(&names[at], apps[at], chance >> 20);
            most = most.max(node.stores.untold_of_apps.most());
        }
        // and read on
        node.read_all();
        // then: what they know is so
        let mut ready: Vec<_> =
            apps.iter().filter_map(|is| if let Is::Ready(app) = is { Some(*app) } else { None }).collect();
        ready.extend([gait, sensor, new_drive]);
        ready.sort_unstable();
        assert_eq!(node.audience.iter().copied().collect::<Vec<_>>(), ready);
        let (known, more) = node.core.own_apps(Time::ZERO, usize::MAX);
        let known_ready: Vec<_> = known.iter().filter(|app| app.ready).map(|app| app.app).collect();
        assert_eq!((known_ready, more), (ready, 0));
        let names_of = |app: AppAddress| lock(&node.stores.registry).name_of(app);
        assert!(known.iter().all(|app| app.name.as_deref() == Some(&*names_of(app.app))));
        assert_eq!(known.len(), lock(&node.stores.registry).len());
        // and gait has heard of both ends
        let lost = |name: &str| (gait, RequirementEvent::Lost { name: name.to_owned() });
        let met = |name: &str| (gait, RequirementEvent::Met { name: name.to_owned() });
        assert_eq!(node.told, [lost("sensor"), met("sensor"), lost("drive"), met("drive")]);
        // and no more waited than there may be applications
        assert!(most > 0 && most <= 5 * APPS_MAX, "{most}");
        assert_eq!(node.stores.untold_of_apps.most(), 0);
    }
}
