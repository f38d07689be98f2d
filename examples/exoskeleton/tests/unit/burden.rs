//! Tests of `src/robot/drive/burden.rs`.

use super::*;

#[test]
fn burden_is_limited_and_only_for_the_named_joint() {
    let twelve = Some(Burden(Duration::from_millis(12)));
    assert_eq!(Burden::parse("knee:12", Joint::Knee), twelve);
    for text in ["knee:12", "hip", "hip:", "hip:0", "hip:51", "hip:x"] {
        assert_eq!(Burden::parse(text, Joint::Hip), None, "{text}");
    }
}
