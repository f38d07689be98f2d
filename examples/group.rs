//! An emergency stop: one message to a group, with the outcome of each member.
//!
//! Run it: `cargo run -p sinew-examples --example group`

use std::process::ExitCode;

use sinew::{app::GroupOutcome, prelude::*};

payload!("group.stop" => struct Stop);

const JOINTS: [&str; 3] = ["hip", "knee", "ankle"];

struct Drive {
    joint: &'static str,
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.join("drives");
    }
}

impl Handler<Delivery<Stop>> for Drive {
    type Result = ();

    fn handle(&mut self, _: Delivery<Stop>, _: &mut Self::Context) {
        println!("the {} stops", self.joint);
    }
}

struct Operator;

impl Actor for Operator {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let within = Duration::from_millis(500);
        let stop = ctx.message(Tid::group("drives"), &Stop).with_tag(1).confirmed_by_each(within);
        if let Err(error) = stop {
            eprintln!("no drive was sent the stop: {error}");
            ctx.stop();
        }
    }
}

impl Handler<GroupOutcome> for Operator {
    type Result = ();

    fn handle(&mut self, sent: GroupOutcome, ctx: &mut Self::Context) {
        let stopped = sent.members.iter().filter(|member| member.outcome == Outcome::Delivered);
        println!("{} of {} drives have confirmed", stopped.count(), sent.members.len());
        ctx.stop();
    }
}

fn main() -> ExitCode {
    // If the operator fails, its node sends the stop in its name.
    let operator = AppSpec::new("operator", || Operator).last_will(Tid::group("drives"), &Stop);
    let operator = operator.requires(JOINTS).restart(Restart::Transient).significant();
    let node = Node::builder("group").configure(|config| config.project = "group".to_owned());
    let drive = |joint| AppSpec::new(joint, move || Drive { joint }).handles::<Stop>();
    let node = JOINTS.into_iter().fold(node, |node, joint| node.app(drive(joint)));
    node.app(operator).auto_shutdown(AutoShutdown::AnySignificant).run()
}
