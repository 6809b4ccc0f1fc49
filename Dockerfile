# Runs README's two commands when it is built: the first installs the package and runs the main job, the second the tests.
# docker build -t ctgraph_rl . && docker run --rm -v "$PWD/runs:/app/runs" ctgraph_rl agent=ppo seed=0
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
WORKDIR /app
COPY . .
SHELL ["/bin/bash", "-c"]
RUN python3 -m venv .venv && . .venv/bin/activate && pip install -c constraints.txt -e . && python -m ctgraph_rl.run curriculum=su_b1_4tasks
ARG TESTS=no
RUN [ "$TESTS" = no ] || { python3 -m venv .venv && . .venv/bin/activate && pip install -c constraints.txt -e '.[test]' && pytest; }
ENV PATH=/app/.venv/bin:$PATH
ENTRYPOINT ["ctgraph-rl"]
