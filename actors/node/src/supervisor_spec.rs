//! A user-declared supervisor: its strategy, its limits, its children.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::{
    app::{DynApp, Requirement},
    name::check_name,
    supervision::{AutoShutdown, Flags, Intensity, Policy, Restart, Strategy},
};

use super::{StartError, thread_placement};

/// Declares a supervisor: which children are restarted when one fails, how often, and its children. Children
/// are applications and supervisors, in the order of their start; they are stopped in reverse order.
///
/// Three actors of a leg that only make sense together, so that the failure of one restarts all. The leg may
/// fail twice in ten seconds. At the third failure its supervisor gives up, and the supervisor above restarts
/// it with a limit of its own:
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
///
/// struct Motor;
/// struct Controller;
/// struct Encoder;
/// impl Actor for Motor { type Context = AppContext<Self>; }
/// impl Actor for Controller { type Context = AppContext<Self>; }
/// impl Actor for Encoder {
///     type Context = AppContext<Self>;
///     fn started(&mut self, ctx: &mut Self::Context) {
///         let _ = ctx.send("controller", &Angle { degrees: 42.0 });
///     }
/// }
/// impl Handler<Delivery<Angle>> for Controller {
///     type Result = ();
///     fn handle(&mut self, angle: Delivery<Angle>, _: &mut Self::Context) {
///         assert!(angle.degrees < 90.0, "no knee bends like this");
///     }
/// }
///
/// let leg = SupervisorSpec::new("leg")
///     .strategy(Strategy::OneForAll)
///     .intensity(2, Duration::from_secs(10))
///     .app(AppSpec::new("motor", || Motor))
///     .app(AppSpec::new("controller", || Controller).handles::<Angle>())
///     .app(AppSpec::new("encoder", || Encoder));
/// # let alone = |config: &mut NodeConfig| (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
/// let node = Node::builder("left").address([127, 0, 0, 33]).supervisor(leg)
/// #   .configure(alone)
///     .start()?;
/// node.handle().wait_until_running(Duration::from_secs(10))?;
/// println!("{}", node.handle().tree()?);
/// node.stop();
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct SupervisorSpec {
    pub(super) name: String,
    pub(super) flags: Flags,
    pub(super) policy: Policy,
    pub(super) members: Vec<Member>,
}

/// A child, at its position in the start order.
#[expect(clippy::large_enum_variant, reason = "there are few of them, and only before the start")]
pub(super) enum Member {
    App(DynApp),
    Supervisor(SupervisorSpec),
}

impl std::fmt::Debug for Member {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::App(app) => f.write_str(app.name()),
            Self::Supervisor(spec) => spec.fmt(f),
        }
    }
}

impl SupervisorSpec {
    /// Returns a supervisor called `name` (unique among the applications and supervisors of its node) without children.
    pub fn new(name: impl Into<String>) -> Self {
        Self { name: name.into(), flags: Flags::default(), policy: Policy::default(), members: Vec::new() }
    }

    /// Sets which children are restarted when one fails. Default: that one alone. With the two other
    /// strategies, children are also started in order, each when the one before it is ready.
    #[must_use]
    pub const fn strategy(mut self, strategy: Strategy) -> Self {
        self.flags.strategy = strategy;
        self
    }

    /// Sets the maximum number of restarts in one window. At one more, the supervisor stops its children and
    /// gives up, which counts as a child's failure at its own supervisor. Default: 5 in 10 s.
    #[must_use]
    pub const fn intensity(mut self, restarts_max: usize, window: Duration) -> Self {
        self.flags.intensity =
            Intensity { restarts_max, window, losses_max: self.flags.intensity.losses_max };
        self
    }

    /// Sets whether it ends when its significant children have finished. Default: never.
    #[must_use]
    pub const fn auto_shutdown(mut self, auto_shutdown: AutoShutdown) -> Self {
        self.flags.auto_shutdown = auto_shutdown;
        self
    }

    /// Sets how many abandoned incarnations, which hung or did not stop, may keep their threads; at one more
    /// it gives up. Default: 3.
    #[must_use]
    pub const fn abandoned_max(mut self, lives: usize) -> Self {
        self.flags.abandoned_max = lives;
        self
    }

    /// Sets when its own supervisor restarts it, with a fresh set of its children. Default: always.
    #[must_use]
    pub const fn restart(mut self, restart: Restart) -> Self {
        self.policy.restart = restart;
        self
    }

    /// Marks it as significant: its end may end its own supervisor; see [`AutoShutdown`].
    #[must_use]
    pub const fn significant(mut self) -> Self {
        self.policy.significant = true;
        self
    }

    /// Adds an application as the last child.
    #[must_use]
    pub fn app(mut self, app: impl Into<DynApp>) -> Self {
        self.members.push(Member::App(app.into()));
        self
    }

    /// Adds a supervisor as the last child.
    #[must_use]
    pub fn supervisor(mut self, spec: Self) -> Self {
        self.members.push(Member::Supervisor(spec));
        self
    }

    /// Returns the applications of this supervisor and of all below it, in the order of their start.
    pub(crate) fn apps(&self) -> Vec<&DynApp> {
        self.members.iter().flat_map(Member::apps).collect()
    }

    /// The same, moved out.
    pub(crate) fn into_apps(self) -> Vec<DynApp> {
        let taken = |member| match member {
            Member::App(app) => vec![app],
            Member::Supervisor(below) => below.into_apps(),
        };
        self.members.into_iter().flat_map(taken).collect()
    }

    /// Returns the application called `name`, here or below.
    #[cfg(feature = "fault-points")]
    pub(super) fn app_mut(&mut self, name: &str) -> Option<&mut DynApp> {
        self.members.iter_mut().find_map(|member| match member {
            Member::App(app) => (app.name() == name).then_some(app),
            Member::Supervisor(below) => below.app_mut(name),
        })
    }

    /// Checks for all faults that can be found before the start.
    pub(super) fn check(&self) -> Result<(), StartError> {
        let mut names = BTreeSet::new();
        self.check_names(&mut names)?;
        self.check_significance()?;
        self.check_places()?;
        let mut edges = Edges::default();
        self.enter(&mut edges);
        edges.check()?;
        self.check_requirements()
    }

    /// Finds applications of this node that require each other in a circle. A name that this node does not
    /// have breaks the circle: another node may have it. spec: SYNC-7
    fn check_requirements(&self) -> Result<(), StartError> {
        let read = |app: &DynApp| app.requires().iter().filter_map(|text| text.parse().ok()).collect();
        let apps: BTreeMap<&str, Vec<Requirement>> =
            self.apps().into_iter().map(|app| (app.name(), read(app))).collect();
        sinew_sync::cycle_of(&apps).map_or(Ok(()), |names| Err(StartError::Cycle(names)))
    }

    fn check_names<'a>(&'a self, names: &mut BTreeSet<&'a str>) -> Result<(), StartError> {
        for member in &self.members {
            if let Err(why) = check_name(member.name()) {
                return Err(StartError::BadName { name: member.name().escape_default().to_string(), why });
            }
            if !names.insert(member.name()) {
                return Err(StartError::SameName(member.name().to_owned()));
            }
            if let Member::Supervisor(below) = member {
                below.check_names(names)?;
            }
        }
        Ok(())
    }

    fn check_places(&self) -> Result<(), StartError> {
        let apps = self.apps();
        for (index, app) in apps.iter().enumerate() {
            let before = apps[..index].iter().map(|other| (other.name(), other.place()));
            thread_placement::check(app.name(), app.place(), before)?;
        }
        Ok(())
    }

    /// As in OTP: a significant child without effect is an error.
    fn check_significance(&self) -> Result<(), StartError> {
        for member in &self.members {
            let policy = member.policy();
            if policy.significant && policy.restart == Restart::Permanent {
                return Err(StartError::PermanentSignificant(member.name().to_owned()));
            }
            if policy.significant && self.flags.auto_shutdown == AutoShutdown::Never {
                let (child, supervisor) = (member.name().to_owned(), self.name.clone());
                return Err(StartError::SignificantForNobody { child, supervisor });
            }
            if let Member::Supervisor(below) = member {
                below.check_significance()?;
            }
        }
        Ok(())
    }

    fn enter<'a>(&'a self, edges: &mut Edges<'a>) {
        for member in &self.members {
            match member {
                Member::App(app) => {
                    edges.requires.insert(app.name(), required_names(app.requires()));
                }
                Member::Supervisor(below) => below.enter(edges),
            }
        }
        if self.flags.strategy == Strategy::OneForOne {
            return;
        }
        for (before, after) in self.members.iter().zip(self.members.iter().skip(1)) {
            for app in after.apps() {
                let follows = before.apps().into_iter().map(|earlier| (app.name(), earlier.name()));
                edges.follows.extend(follows);
            }
        }
    }
}

impl Member {
    fn name(&self) -> &str {
        match self {
            Self::App(app) => app.name(),
            Self::Supervisor(spec) => &spec.name,
        }
    }

    fn policy(&self) -> &Policy {
        match self {
            Self::App(app) => app.policy(),
            Self::Supervisor(spec) => &spec.policy,
        }
    }

    fn apps(&self) -> Vec<&DynApp> {
        match self {
            Self::App(app) => vec![app],
            Self::Supervisor(below) => below.apps(),
        }
    }
}

/// The wait graph of this node: by requirements, and by the order of start.
#[derive(Default)]
struct Edges<'a> {
    requires: BTreeMap<&'a str, Vec<String>>,
    follows: Vec<(&'a str, &'a str)>,
}

impl<'a> Edges<'a> {
    /// Checks the graph. The sync manager finds circles by requirements alone, because it also knows other nodes.
    fn check(&self) -> Result<(), StartError> {
        for (after, before) in &self.follows {
            if let Some(path) = self.path(before, after) {
                let mut names = vec![(*after).to_owned()];
                names.extend(path.into_iter().map(str::to_owned));
                return Err(StartError::OrderCycle(names));
            }
        }
        Ok(())
    }

    /// Returns the path on which `from` waits for `to`, if there is one, both ends included.
    fn path<'b>(&'b self, from: &'b str, to: &'b str) -> Option<Vec<&'b str>> {
        let mut reached = BTreeMap::from([(from, from)]);
        let mut next = vec![from];
        while let Some(name) = next.pop() {
            let required = self.requires.get(name).into_iter().flatten().map(String::as_str);
            let before = self.follows.iter().filter(|(after, _)| *after == name).map(|(_, before)| *before);
            for other in required.chain(before) {
                if reached.contains_key(other) {
                    continue;
                }
                reached.insert(other, name);
                next.push(other);
            }
        }
        let mut path = vec![*reached.get_key_value(to)?.0];
        while let Some(name) = path.last().filter(|name| **name != from) {
            path.push(reached[name]);
        }
        path.reverse();
        Some(path)
    }
}

/// Returns the names that an application requires in any case before its start.
fn required_names(requires: &[String]) -> Vec<String> {
    let read = requires.iter().filter_map(|text| text.parse::<Requirement>().ok());
    let read = read.filter(|requirement| requirement.wait_max().is_none());
    read.filter_map(|requirement| requirement.one_name().map(str::to_owned)).collect()
}

#[cfg(test)]
mod tests {
    use actix::Actor;
    use sinew_runtime::app::{AppContext, AppSpec};

    use super::*;

    struct Idle;

    impl Actor for Idle {
        type Context = AppContext<Self>;
    }

    fn app(name: &str) -> AppSpec<Idle> {
        AppSpec::new(name, || Idle)
    }

    fn ordered(name: &str) -> SupervisorSpec {
        SupervisorSpec::new(name).strategy(Strategy::RestForOne)
    }

    #[test]
    fn requirement_on_later_child_is_found_before_start() {
        let below = ordered("leg").app(app("a")).app(app("b"));
        let spec = ordered("all").app(app("first").requires(["b"])).supervisor(below);
        let error = spec.check().expect_err("none of these can be first");
        assert_eq!(
            error.to_string(),
            "these applications wait for each other in a circle, by the order of their start and by what they require: \
             b -> a -> first -> b; change the order, or take a requirement out"
        );
    }

    #[test]
    fn requirements_along_the_order_are_no_cycle() {
        let spec =
            ordered("all").app(app("a")).app(app("b").requires(["a"])).app(app("c").requires(["a", "x"]));
        assert!(spec.check().is_ok());
    }

    #[test]
    fn names_are_unique_across_all_levels() {
        let spec = SupervisorSpec::new("all").app(app("a")).supervisor(SupervisorSpec::new("a"));
        assert!(matches!(spec.check(), Err(StartError::SameName(name)) if name == "a"));
    }

    #[test]
    fn significance_without_effect_is_a_mistake() {
        let never = SupervisorSpec::new("all").app(app("a").restart(Restart::Transient).significant());
        assert!(matches!(never.check(), Err(StartError::SignificantForNobody { .. })));
        let permanent = SupervisorSpec::new("all")
            .auto_shutdown(AutoShutdown::AnySignificant)
            .app(app("a").significant());
        assert!(matches!(permanent.check(), Err(StartError::PermanentSignificant(_))));
    }
}
