//! The optimiser against values computed independently.

use super::*;
use crate::train::loss::{normalise_rows, triplet_margin_loss};
use candle_core::Device;
use serde::Deserialize;

/// Made by `tests/fixtures/train/make_triplet_step.py` with PyTorch.
#[derive(Deserialize)]
struct Fixture {
    margin: f64,
    rate: f64,
    query: Vec<Vec<f32>>,
    positive: Vec<Vec<f32>>,
    negative: Vec<Vec<f32>>,
    weight: Vec<Vec<f32>>,
    bias: Vec<f32>,
    steps: Vec<Step>,
}

#[derive(Deserialize)]
struct Step {
    loss: f32,
    weight_gradient: Vec<Vec<f32>>,
    weight: Vec<Vec<f32>>,
    bias: Vec<f32>,
}

fn matrix(rows: &[Vec<f32>]) -> Tensor {
    Tensor::from_vec(rows.concat(), (rows.len(), rows[0].len()), &Device::Cpu).unwrap()
}

fn assert_near(what: &str, actual: &Tensor, expected: &[f32], tolerance: f32) {
    let actual = actual.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let worst = actual
        .iter()
        .zip(expected)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(
        actual.len() == expected.len() && worst < tolerance,
        "{what}: off by {worst}"
    );
}

#[test]
fn loss_gradient_and_steps_are_those_of_pytorch() {
    let fixture: Fixture = serde_json::from_str(include_str!(
        "../../../../../tests/fixtures/train/triplet_step.json"
    ))
    .unwrap();
    let weight = Var::from_tensor(&matrix(&fixture.weight)).unwrap();
    let bias =
        Var::from_tensor(&Tensor::new(fixture.bias.as_slice(), &Device::Cpu).unwrap()).unwrap();
    let mut adam = Adam::new(vec![
        ("weight".into(), weight.clone()),
        ("bias".into(), bias.clone()),
    ])
    .unwrap();
    for step in &fixture.steps {
        let embed = |rows: &[Vec<f32>]| {
            let projected = matrix(rows)
                .matmul(&weight.t().unwrap())
                .unwrap()
                .broadcast_add(&bias)
                .unwrap();
            normalise_rows(&projected).unwrap()
        };
        let query = embed(&fixture.query);
        let positive = embed(&fixture.positive);
        let negative = embed(&fixture.negative);
        let loss = triplet_margin_loss(&query, &positive, &negative, fixture.margin).unwrap();
        assert!((loss.to_scalar::<f32>().unwrap() - step.loss).abs() < 1e-6);
        let gradients = loss.backward().unwrap();
        assert_near(
            "gradient",
            gradients.get(&weight).unwrap(),
            &step.weight_gradient.concat(),
            1e-6,
        );
        adam.step(&gradients, fixture.rate).unwrap();
        assert_near("weight", &weight, &step.weight.concat(), 1e-6);
        assert_near("bias", &bias, &step.bias, 1e-6);
    }
}
