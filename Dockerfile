# The two commands of the README in a container, as a user without rights:
#   docker build --tag cvqmpt . && docker run --rm cvqmpt && docker run --rm cvqmpt make test
FROM python:3.11-slim

# Pinocchio's wheel links libgomp, its Boost libquadmath; git: the commit that stands in results.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends git libgomp1 libquadmath0 make \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home user
USER user
WORKDIR /home/user/cvqmpt
COPY --chown=user:user . .
RUN make venv
CMD ["make", "reproduce"]
