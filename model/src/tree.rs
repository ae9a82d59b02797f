//! Structs of scalars as flat lists of named leaves.
//!
//! A [`Tree`] is what a pytree is to JAX: states, inputs, parameters and messages are structs with named fields, and
//! everything that treats all numbers alike (recording, integration, fitting, tracing) sees the leaves in order.
//!
//! Leaf names are dotted paths. A field of a struct adds its name (`position.x`); the elements of an array add their
//! index to the array's name (`motor: [T; 4]` has the leaves `motor_0` to `motor_3`, an array of structs
//! `leg_0.angle`). Between dots every part is a legal ROS 2 field name.
//!
//! ```
//! use parallax_model::tree::{Tree, leaf_names};
//!
//! #[derive(Tree)]
//! struct Vector<T> {
//!     x: T,
//!     y: T,
//! }
//!
//! #[derive(Tree)]
//! struct State<T> {
//!     position: Vector<T>,
//!     motor: [T; 2],
//! }
//!
//! assert_eq!(leaf_names::<f64, State<f64>>(), ["position.x", "position.y", "motor_0", "motor_1"]);
//! let state = State { position: Vector { x: 1.0, y: 2.0 }, motor: [3.0, 4.0] };
//! let mut leaves = [0.0; 4];
//! state.write_to(&mut leaves);
//! assert_eq!(leaves, [1.0, 2.0, 3.0, 4.0]);
//! assert_eq!(State::<f64>::read_from(&leaves).motor, [3.0, 4.0]);
//! ```

use std::marker::PhantomData;

pub use parallax_model_derive::Tree;

use crate::scalar::Scalar;

/// A struct of scalars `T`, seen as a flat list of named leaves. Derive it.
///
/// The order of the leaves is the order of the fields, and the same in every method.
///
/// A name that a recording could not carry, and two leaves of one name, do not compile:
///
/// ```compile_fail
/// #[derive(parallax_model::Tree)]
/// struct State<T> {
///     angle__arm: T,
/// }
/// ```
///
/// ```compile_fail
/// #[derive(parallax_model::Tree)]
/// struct State<T> {
///     motor: [T; 2],
///     motor_1: T,
/// }
/// ```
///
/// ```compile_fail,E0277
/// #[derive(parallax_model::Tree)]
/// struct State<T> {
///     name: String,
///     angle: T,
/// }
/// ```
#[diagnostic::on_unimplemented(
    message = "`{Self}` is not a tree of `{T}`",
    label = "not a scalar `{T}`, a tree of it, or an array of either",
    note = "fields of a `Tree` are scalars of its one type parameter, other trees over it, or arrays of them"
)]
pub trait Tree<T>: Sized {
    /// How many leaves there are.
    const LEAVES: usize;

    /// Appends the name of every leaf, each below `prefix` (empty at the root).
    fn names(prefix: &str, out: &mut Vec<String>);

    /// Calls `leaf` with every leaf.
    fn visit(&self, leaf: &mut impl FnMut(T));

    /// Makes a tree from leaves that `next` hands out in order.
    fn build(next: &mut impl FnMut() -> T) -> Self;

    /// Combines two trees leaf by leaf.
    fn zip(&self, other: &Self, combine: &mut impl FnMut(T, T) -> T) -> Self;

    /// Appends the leaves to `out`.
    fn write(&self, out: &mut Vec<T>) {
        out.reserve(Self::LEAVES);
        self.visit(&mut |leaf| out.push(leaf));
    }

    /// Writes the leaves to `out`, without allocating.
    ///
    /// # Panics
    ///
    /// When `out` does not hold exactly [`Tree::LEAVES`] values.
    #[inline(always)]
    fn write_to(&self, out: &mut [T]) {
        assert_eq!(out.len(), Self::LEAVES, "a slice of this length cannot hold the tree's leaves");
        let mut slots = out.iter_mut();
        self.visit(&mut |leaf| {
            if let Some(slot) = slots.next() {
                *slot = leaf;
            }
        });
    }

    /// Takes the leaves from an iterator.
    ///
    /// # Panics
    ///
    /// When the iterator ends before [`Tree::LEAVES`] values.
    fn read(leaves: &mut impl Iterator<Item = T>) -> Self {
        Self::build(&mut || leaves.next().expect("the iterator ended before the tree's last leaf"))
    }

    /// Makes the tree from a slice of leaves, without allocating.
    ///
    /// # Panics
    ///
    /// When `leaves` does not hold exactly [`Tree::LEAVES`] values.
    #[inline(always)]
    fn read_from(leaves: &[T]) -> Self
    where
        T: Copy,
    {
        assert_eq!(leaves.len(), Self::LEAVES, "a slice of this length does not hold the tree's leaves");
        let mut index = 0;
        Self::build(&mut || {
            index += 1;
            leaves[index - 1]
        })
    }

    /// The leaves as a new vector.
    fn to_vec(&self) -> Vec<T> {
        let mut out = Vec::new();
        self.write(&mut out);
        out
    }
}

/// The names of all leaves of `S`, in order.
pub fn leaf_names<T, S: Tree<T>>() -> Vec<String> {
    let mut out = Vec::with_capacity(S::LEAVES);
    S::names("", &mut out);
    out
}

/// The tree `B` over `T` whose leaves are those of `a`, lifted to constants: nominal parameters in `f64` as numbers of
/// any scalar.
///
/// # Panics
///
/// When the two trees differ in their number of leaves: they must be one struct over two scalars.
pub fn lift<T: Scalar, A: Tree<f64>, B: Tree<T>>(a: &A) -> B {
    assert_eq!(A::LEAVES, B::LEAVES, "lift needs the same struct over another scalar");
    let leaves = a.to_vec();
    B::read(&mut leaves.into_iter().map(T::constant))
}

/// `name` below `prefix`, with a dot between them. Used by the derived code.
pub fn join(prefix: &str, name: &str) -> String {
    if prefix.is_empty() { name.to_owned() } else { format!("{prefix}.{name}") }
}

/// A scalar is a tree of one leaf; alone, without a field's name, the leaf is called `value`.
impl<T: Scalar> Tree<T> for T {
    const LEAVES: usize = 1;

    fn names(prefix: &str, out: &mut Vec<String>) {
        out.push(if prefix.is_empty() { "value".to_owned() } else { prefix.to_owned() });
    }
    #[inline(always)]
    fn visit(&self, leaf: &mut impl FnMut(T)) {
        leaf(*self);
    }
    #[inline(always)]
    fn build(next: &mut impl FnMut() -> T) -> Self {
        next()
    }
    #[inline(always)]
    fn zip(&self, other: &Self, combine: &mut impl FnMut(T, T) -> T) -> Self {
        combine(*self, *other)
    }
}

impl<T: Scalar, E: Tree<T>, const N: usize> Tree<T> for [E; N] {
    const LEAVES: usize = N * E::LEAVES;

    fn names(prefix: &str, out: &mut Vec<String>) {
        let array = if prefix.is_empty() { "value" } else { prefix };
        for index in 0..N {
            E::names(&format!("{array}_{index}"), out);
        }
    }
    #[inline(always)]
    fn visit(&self, leaf: &mut impl FnMut(T)) {
        for element in self {
            element.visit(leaf);
        }
    }
    #[inline(always)]
    fn build(next: &mut impl FnMut() -> T) -> Self {
        std::array::from_fn(|_| E::build(next))
    }
    #[inline(always)]
    fn zip(&self, other: &Self, combine: &mut impl FnMut(T, T) -> T) -> Self {
        std::array::from_fn(|index| self[index].zip(&other[index], combine))
    }
}

/// No leaves: the parameters of a model that has none.
impl<T: Scalar> Tree<T> for () {
    const LEAVES: usize = 0;

    fn names(_prefix: &str, _out: &mut Vec<String>) {}
    #[inline(always)]
    fn visit(&self, _leaf: &mut impl FnMut(T)) {}
    #[inline(always)]
    fn build(_next: &mut impl FnMut() -> T) -> Self {}
    #[inline(always)]
    fn zip(&self, _other: &Self, _combine: &mut impl FnMut(T, T) -> T) -> Self {}
}

/// No leaves: keeps a type parameter that no field uses.
impl<T: Scalar> Tree<T> for PhantomData<T> {
    const LEAVES: usize = 0;

    fn names(_prefix: &str, _out: &mut Vec<String>) {}
    #[inline(always)]
    fn visit(&self, _leaf: &mut impl FnMut(T)) {}
    #[inline(always)]
    fn build(_next: &mut impl FnMut() -> T) -> Self {
        PhantomData
    }
    #[inline(always)]
    fn zip(&self, _other: &Self, _combine: &mut impl FnMut(T, T) -> T) -> Self {
        PhantomData
    }
}

/// Two trees side by side, with the leaves named `first` and `second` below the prefix.
impl<T: Scalar, A: Tree<T>, B: Tree<T>> Tree<T> for (A, B) {
    const LEAVES: usize = A::LEAVES + B::LEAVES;

    fn names(prefix: &str, out: &mut Vec<String>) {
        A::names(&join(prefix, "first"), out);
        B::names(&join(prefix, "second"), out);
    }
    #[inline(always)]
    fn visit(&self, leaf: &mut impl FnMut(T)) {
        self.0.visit(leaf);
        self.1.visit(leaf);
    }
    #[inline(always)]
    fn build(next: &mut impl FnMut() -> T) -> Self {
        (A::build(next), B::build(next))
    }
    #[inline(always)]
    fn zip(&self, other: &Self, combine: &mut impl FnMut(T, T) -> T) -> Self {
        (self.0.zip(&other.0, combine), self.1.zip(&other.1, combine))
    }
}
