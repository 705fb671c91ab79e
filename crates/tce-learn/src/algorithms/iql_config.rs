//! The configuration of implicit Q-learning, which is the basis of several methods.

use serde::{Deserialize, Serialize};

use crate::actor::{ActorConfig, PolicyForm};
use crate::buffer::RewardScale;
use crate::error::{LearnError, within};
use crate::losses::AdvantageScale;
use crate::regulariser::RegulariserKind;

/// How the critics' advantages reach the policy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PolicyExtraction {
    /// Weighted squared error of a deterministic policy (or of a tanh-Gaussian's mean).
    #[default]
    AwrMse,
    /// Weighted log-likelihood of a normal policy with a standard deviation per action dimension.
    AwrLogprob,
    /// As `awr_mse`, every row with the mean weight of its batch: what OTDF's code does.
    MeanWeight,
}

/// The configuration of [`crate::Iql`]; see [`crate::iql`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default = "IqlConfig::paper")]
pub struct IqlConfig {
    /// τ_V, the expectile of Q that V is regressed on. Source: Eq. B.12, Appendix B.2.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub expectile: f64,
    /// β_Adv, how sharply the policy prefers actions with an advantage. Source: Eq. B.14, Appendix B.2: 3.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub temperature: f64,
    /// Greatest weight of a row in the policy's loss. Source: IQL's authors, OTDF.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e+30))]
    pub weight_cap: f64,
    /// γ, the discount factor. Source: OTDF, IQL.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub discount: f64,
    /// ρ, how far target networks follow in one step. Source: OTDF, IQL.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub polyak: f64,
    /// Learning rate of V and Q, constant. Source: Table C.4.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub critic_lr: f64,
    /// Widths of the hidden layers of V and Q. Source: OTDF, IQL.
    pub hidden: Vec<usize>,
    /// The policy; its `form` follows from `policy_extraction` and `regulariser`.
    pub actor: ActorConfig,
    /// How advantages become a policy. Source: OTDF as meant.
    pub policy_extraction: PolicyExtraction,
    /// Units of the advantage before β_Adv multiplies it. Source: the paper's are raw.
    pub advantage: AdvantageScale,
    /// What rewards are multiplied by before a critic sees them. Source: OTDF does without.
    pub reward_scale: RewardScale,
    /// β_reg, the weight of the behaviour term in the policy's loss. Source: Table C.5.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub beta_reg: f64,
    /// What keeps the policy near the target's behaviour. Source: Eq. 10 is forward_kl.
    pub regulariser: RegulariserKind,
}

impl IqlConfig {
    /// Appendix B.2 without the behaviour term: the paper's IQL*. The best settings are in the presets of `tce-run`.
    pub fn paper() -> Self {
        Self {
            expectile: 0.7,
            temperature: 3.0,
            weight_cap: 100.0,
            discount: 0.99,
            polyak: 0.005,
            critic_lr: 3e-4,
            hidden: vec![256, 256],
            actor: ActorConfig::default(),
            policy_extraction: PolicyExtraction::default(),
            advantage: AdvantageScale::default(),
            reward_scale: RewardScale::default(),
            beta_reg: 1e-3,
            regulariser: RegulariserKind::default(),
        }
    }
}

impl IqlConfig {
    /// Returns an error for numbers out of range, and for combinations that cannot be trained.
    ///
    /// # Errors
    /// The error names the field.
    pub fn check(&self) -> Result<(), LearnError> {
        within("expectile", self.expectile, 0.0..=1.0)?;
        within("temperature", self.temperature, 0.0..=1e6)?;
        within("weight_cap", self.weight_cap, f64::MIN_POSITIVE..=1e30)?;
        within("discount", self.discount, 0.0..=1.0)?;
        within("polyak", self.polyak, 0.0..=1.0)?;
        within("critic_lr", self.critic_lr, 0.0..=1.0)?;
        within("beta_reg", self.beta_reg, 0.0..=1e6)?;
        if self.regulariser == RegulariserKind::Otdf && self.policy_extraction == PolicyExtraction::AwrLogprob {
            let remedy = "choose awr_mse or mean_weight, or another regulariser";
            return Err(LearnError::invalid(
                "policy_extraction",
                "awr_logprob",
                "a tanh-Gaussian policy for OTDF",
                remedy,
            ));
        }
        Ok(())
    }

    pub(crate) fn form(&self) -> PolicyForm {
        match (self.policy_extraction, self.regulariser) {
            (PolicyExtraction::AwrLogprob, _) => PolicyForm::Gaussian,
            (_, RegulariserKind::Otdf) => PolicyForm::TanhGaussian,
            _ => PolicyForm::TanhMean,
        }
    }
}
