//! Two applications of one node with a direct link.

use sinew::audit::Account;

use super::*;

#[test]
fn direct_link_is_shown_with_what_waits_in_it() {
    let mut facts = free();
    let mut sensor = app("sensor");
    sensor.report.as_mut().expect("it is listed").tid = Tid::new(node(2), AppAddress::new(0x1002));
    let account = Account { taken: 30, superseded: 2, delivered: 20, waiting: 8, ..Account::default() };
    let to = AppAddress::new(0x1001);
    sensor.direct = vec![(to, account), (AppAddress::new(0x1003), Account::default())];
    facts.ends[0] = TrafficEnd { wanted: "sensor".to_owned(), app: Some(sensor), ..facts.ends[1].clone() };
    let steps = judge(&facts);
    let shown: Vec<_> = steps.iter().filter(|step| step.what.contains("direct link")).collect();
    let [step] = shown[..] else { panic!("{shown:?}") };
    assert_eq!((step.what.as_str(), step.state), ("sensor has a direct link to knee.drive", State::Fine));
    assert_eq!(
        step.detail,
        "28 messages went past the node, 20 of them are read; 8 wait until knee.drive receives"
    );
}
