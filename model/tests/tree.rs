//! Trees: order and names of leaves, nesting, arrays, and all ways to take them apart and build them.

use std::marker::PhantomData;

use parallax_model::Tree;
use parallax_model::tree::{leaf_names, lift};
use proptest::prelude::*;

#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct Vector<T> {
    x: T,
    y: T,
    z: T,
}

#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct Wheel<T> {
    speed: T,
    slip: [T; 2],
}

#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct Nothing;

#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct Robot<T, const N: usize> {
    position: Vector<T>,
    wheel: [Wheel<T>; N],
    r#type: T,
    nothing: Nothing,
    unit: (),
}

#[derive(Tree, Clone, Debug, Default, PartialEq)]
struct Reading {
    angle: f64,
    force: [f64; 2],
}

#[derive(Tree)]
struct Phantom<T> {
    unused: PhantomData<T>,
}

#[test]
fn names_are_dotted_paths_in_field_order() {
    assert_eq!(
        leaf_names::<f64, Robot<f64, 2>>(),
        [
            "position.x",
            "position.y",
            "position.z",
            "wheel_0.speed",
            "wheel_0.slip_0",
            "wheel_0.slip_1",
            "wheel_1.speed",
            "wheel_1.slip_0",
            "wheel_1.slip_1",
            "type",
        ]
    );
    assert_eq!(leaf_names::<f64, Reading>(), ["angle", "force_0", "force_1"]);
    assert_eq!(leaf_names::<f64, f64>(), ["value"]);
    assert_eq!(
        leaf_names::<f64, (f64, Reading)>(),
        ["first", "second.angle", "second.force_0", "second.force_1"]
    );
    assert!(leaf_names::<f64, Nothing>().is_empty());
    assert!(leaf_names::<f64, Phantom<f64>>().is_empty());
    assert_eq!(<Phantom<f64> as Tree<f64>>::LEAVES, 0);
}

#[test]
fn a_prefix_goes_before_every_name() {
    let mut names = Vec::new();
    <Vector<f64> as Tree<f64>>::names("goal", &mut names);
    assert_eq!(names, ["goal.x", "goal.y", "goal.z"]);
}

#[test]
#[should_panic(expected = "cannot hold the tree's leaves")]
fn writing_to_a_slice_of_the_wrong_length_panics() {
    Reading::default().write_to(&mut [0.0; 2]);
}

proptest! {
    #[test]
    fn every_way_in_and_out_keeps_the_leaves(leaves in proptest::collection::vec(-1e6..1e6f64, 10)) {
        let robot = Robot::<f64, 2>::read_from(&leaves);
        prop_assert_eq!(robot.wheel[1].slip[0], leaves[7]);
        prop_assert_eq!(&robot.to_vec(), &leaves);
        let mut written = [0.0; 10];
        robot.write_to(&mut written);
        prop_assert_eq!(&written[..], &leaves[..]);
        prop_assert_eq!(Robot::<f64, 2>::read(&mut leaves.iter().copied()), robot);
        let lifted: Robot<f64, 2> = lift(&robot);
        prop_assert_eq!(lifted, robot);
        let doubled = robot.zip(&robot, &mut |a, b| a + b).to_vec();
        prop_assert!(doubled.iter().zip(&leaves).all(|(double, leaf)| *double == 2.0 * leaf));
    }
}
