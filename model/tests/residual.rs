//! Frictions without a form are those of the library where their weights say so.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax_model::effect::{Effect, PlaceKind};
use parallax_model::plant::{Feature, Plant, Residual, Target, Variable};
use parallax_model::system::{Equations, Point, System};

const SMOOTHING: f64 = 0.01;

fn equations() -> Equations {
    let text = r#"
        format = 1
        name = "shaft"
        [parameters]
        J = { value = 0.02, unit = "kg m^2" }
        [inputs]
        u = { signal = "u" }
        [state]
        q = { derivative = "v", initial = "angle" }
        v = { derivative = "u/J" }
        [outputs]
        angle = { value = "q", unit = "rad" }
        [joints]
        shaft = { position = "q", velocity = "v", inertia = "J", drive = "u" }
    "#;
    System::parse(text, "shaft.toml").unwrap().equations().unwrap()
}

fn plant(effects: &[Effect], residuals: Vec<Residual>) -> Plant {
    let effects: Vec<_> = effects.iter().map(|effect| (*effect, PlaceKind::Joint, 0)).collect();
    Plant::new(equations(), &effects, residuals, vec![SMOOTHING])
}

fn derivatives(plant: &Plant, states: &[f64], time: f64, extra: &[f64]) -> Vec<f64> {
    let parameters = plant.equations().nominal();
    plant.derivatives(&Point { parameters: &parameters, states, inputs: &[0.3], time }, extra)
}

#[test]
fn a_friction_that_changes_is_coulombs_while_it_does_not() {
    let bump = |centre: f64| Feature::Bump { of: Variable::Time, centre, width: 2.0 };
    let residual = Residual { target: Target::Friction(0), features: vec![bump(0.0), bump(2.0)] };
    let changing = plant(&[], vec![residual]);
    let coulomb = plant(&[Effect::Coulomb], Vec::new());
    for velocity in [-1.0, -0.004, 0.0, 0.02, 3.0] {
        let states = [0.1, velocity];
        for (time, force) in [(0.0, 0.1), (0.5, 0.125), (2.0, 0.2)] {
            let found = derivatives(&changing, &states, time, &[0.1, 0.2]);
            let expected = derivatives(&coulomb, &states, time, &[force]);
            assert!((found[1] - expected[1]).abs() < 1e-12, "{velocity} at {time}: {found:?}, {expected:?}");
        }
    }
}

#[test]
fn one_bristle_is_dahls_friction_and_several_add_up() {
    let bristles = |deflection: f64| Feature::Bristles { deflection };
    let remembering =
        |features: Vec<Feature>| plant(&[], vec![Residual { target: Target::Hysteresis(0), features }]);
    let dahl = plant(&[Effect::CoulombDahl], Vec::new());
    let (one, two) = (remembering(vec![bristles(0.05)]), remembering(vec![bristles(0.05), bristles(0.2)]));
    for (velocity, bent) in [(-1.0, 0.3), (0.2, -0.9), (0.0, 0.5)] {
        let expected = derivatives(&dahl, &[0.1, velocity, bent], 0.0, &[0.12, 0.05]);
        assert_eq!(derivatives(&one, &[0.1, velocity, bent], 0.0, &[0.12]), expected);
        let both = derivatives(&two, &[0.1, velocity, bent, 0.4], 0.0, &[0.12, -0.03]);
        assert!((both[1] - (expected[1] + 0.03 * 0.4 / 0.02)).abs() < 1e-12);
        assert_eq!((both[2], both.len()), (expected[2], 4));
    }
}
