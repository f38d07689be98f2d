//! The declarations of a client's types.

use sinew_protocol::payload::TypeDeclaration;

use super::*;

fn declaration(schema: Vec<u8>) -> TypeDeclaration {
    let (kind, policy) = (Kind::named("torque"), "refuse".to_owned());
    TypeDeclaration { kind, handles: true, sends: false, policy, protected: false, schema }
}

// spec: LNCL-21
#[test]
fn declaration_reaches_node_and_refusal_costs_nothing_else() {
    let node = TestNode::start();
    let types = node.with_types();
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let lncl = payload::lncl_of(node.address());
    let mut declare = |schema| {
        client.send(&payload::frame(Kind::LNCL_TYPE, tid, lncl, &declaration(schema)));
    };
    declare(Vec::new());
    declare(vec![1, 0, 0]);
    assert_eq!(types.next(), (tid.app, declaration(vec![1, 0, 0])));
    assert_eq!(node.refused("declaration of a type"), 1);
    // A frame that cannot be read ends the connection, as each such frame.
    client.send(&Message::new(Header::new(Kind::LNCL_TYPE, tid, lncl), Bytes::from_static(&[0xc1])));
    assert!(client.expect_refusal().contains("cannot be read"));
}
