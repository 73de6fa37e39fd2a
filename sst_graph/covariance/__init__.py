"""How sure an estimate is: cluster-robust, assumptions considered, weak directions named."""
