//! How long a policy takes to step: two hidden layers, by width and activation.

use std::collections::HashMap;
use std::hint::black_box;
use std::time::Instant;

use parallax_model::Tree;
use parallax_nodes::policy::Policy;
use parallax_runtime::node::Message;
use safetensors::tensor::{Dtype, TensorView, serialize};

#[derive(Tree, Clone, Default)]
struct Body<T = f64> {
    joint: [T; 24],
}

impl Message for Body {
    const NAME: &'static str = "bench/Body";
}

#[derive(Tree, Clone, Default)]
struct Torques<T = f64> {
    joint: [T; 12],
}

impl Message for Torques {
    const NAME: &'static str = "bench/Torques";
}

const STEPS: usize = 20_000;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::temp_dir().join(format!("parallax-policy-{}.safetensors", std::process::id()));
    println!("24 observations, 12 actions       p50        p99");
    for width in [32, 64, 128, 256] {
        for activation in ["relu", "tanh", "swish"] {
            write(&path, width, activation)?;
            let mut policy = Policy::<Body, Torques>::read(&path)?;
            let mut leaves = [0.3; 24];
            let mut taken = Vec::with_capacity(STEPS);
            for step in 0..STEPS {
                leaves[step % 24] = (step as f64 * 0.01).sin();
                let start = Instant::now();
                black_box(policy.act(black_box(&leaves))?);
                taken.push(start.elapsed());
            }
            taken.sort_unstable();
            println!(
                "{width:>4} x {width:<4} {activation:<8} {:>10.2} us {:>7.2} us",
                taken[STEPS / 2].as_secs_f64() * 1e6,
                taken[STEPS * 99 / 100].as_secs_f64() * 1e6
            );
        }
    }
    std::fs::remove_file(&path)?;
    Ok(())
}

fn write(path: &std::path::Path, width: usize, activation: &str) -> Result<(), Box<dyn std::error::Error>> {
    let shapes = [[width, 24], [width, width], [12, width]];
    let number = |i: usize| ((i * 7919 % 1000) as f32 / 1000.0 - 0.5) * 0.3;
    let bytes = |[o, i]: [usize; 2]| (0..o * i).flat_map(|at| number(at).to_le_bytes()).collect();
    let data: Vec<Vec<u8>> = shapes.into_iter().map(bytes).collect();
    let mut tensors = Vec::new();
    for (layer, (shape, data)) in shapes.iter().zip(&data).enumerate() {
        let view = TensorView::new(Dtype::F32, shape.to_vec(), data)?;
        tensors.push((format!("layers.{layer}.weight"), view));
    }
    let metadata = HashMap::from([
        ("format".into(), "parallax-policy-1".into()),
        ("activation".into(), activation.into()),
    ]);
    std::fs::write(path, serialize(tensors, Some(metadata))?)?;
    Ok(())
}
